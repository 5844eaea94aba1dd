"""The denoiser of a shot: it prepares each frame, runs the method, and keeps the state."""

from __future__ import annotations

import os
import warnings
from collections.abc import Collection, Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from types import NoneType
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from mcdenoise.denoiser._frames import dtype_of, explained, prepared
from mcdenoise.denoiser._settings import check_kind, check_settings, usable_device
from mcdenoise.denoiser._turns import in_turn, started
from mcdenoise.denoiser._watch import REPEATED, Watch
from mcdenoise.errors import InputError, check_choice, level_of_caller
from mcdenoise.frame import MOTION, Frame, Hints, tells_motion
from mcdenoise.models import DEFAULT, Model, Output, State, create_model
from mcdenoise.models._contract import absent_buffers, checked_step, owned
from mcdenoise.models._interface import at_hand
from mcdenoise.models._layers import REST, alpha_of, completed, opened
from mcdenoise.models._memory import Division, Frames
from mcdenoise.models._precision import Chosen, Precision, computing_in, fastest_precision, has_network
from mcdenoise.models._report import FrameReport
from mcdenoise.models._times import Times, stages_of
from mcdenoise.models._void import with_void
from mcdenoise.models._weights import model_of
from mcdenoise.models._wrapped import seam, unwrapped, wrapped
from mcdenoise.models._wrapper import as_model, name_of, parts_of
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.noise import noise_of

AskedPrecision = Literal["auto", "float32", "bfloat16"]

# Level of noise up to which bfloat16 makes errors larger: by 41 % at 0.001, 6 % at 0.006, 2 % at 0.02, 1 % at 0.06
# (a network like that of wild, on even surfaces, where they are largest).
_ROUNDED = 0.03


class Denoiser:
    """Denoises the frames of a shot one after the other, and keeps the method's state.

    The motion of the first frames of a shot is examined, on a CPU: a warning tells the likely mistake if another
    convention fits the frames clearly better.

    Denoisers in several threads do not affect one another. Frames that several threads give to one denoiser are
    denoised one after the other, as one shot in the order of their arrival; ``report`` is that of the last of them.

    Args:
        model: the name of a model in the zoo (its shipped weights are loaded), your own ``path/to/file.py:factory`` or
            ``package.module:factory``, a :class:`mcdenoise.models.Model`, or a module or function whose parameters are
            named like buffers (one with a default value is optional). A module of yours is moved to the device, made
            channels-last and put into evaluation mode. By default it is the one that the weights are for, or
            :data:`mcdenoise.models.DEFAULT`.
        weights: a safetensors file of other weights for a model given by name.
        device: device to run on. Frames may come from any device; images are returned on this one.
        precision: precision of convolutions; everything else stays in float32. ``"bfloat16"`` is about twice as fast on
            processors that support it; frames with hardly any noise, which it would make worse, are computed in float32
            all the same (on a GPU by the noise of the frame before, and the first one always). ``"auto"`` chooses it
            for a trained model of the zoo if it is faster on this machine, which is measured once, and float32
            otherwise: for a model of yours, and with ``differentiable``. The attribute ``precision`` holds the chosen
            precision, and the report the reason.
        keep_all: skip nothing, even if the scene does not need it, nor a frame that repeats the noise of the last one.
        tile: largest side of a tile in pixels, a multiple of 32 that is at least 64. The result is that of the whole
            image, up to the rounding of convolutions; overlapping margins cost time. By default tiles are as large as
            memory allows, and the image is not tiled if a network's features take no more than 2 GB (on a GPU: 0.4 of
            its memory). This does not depend on the free memory: the same frames give the same images.
        max_memory: maximum memory in GB of 1e9 bytes: of the process on a CPU, otherwise of torch's allocations on the
            device. Tiles are made small enough to keep below it everything in memory when the denoiser is created, the
            images of a frame, and those of the history. It does not include frames that you keep, except the current
            one.
        differentiable: keep the autograd graph, also through the state, so that ``backward`` reaches every earlier
            frame of the shot. Decisions are treated as constants: which pixels have a history, how much history is
            discarded, and the exposure. The images do not change. Frames of float64 are computed in float64 if the
            weights are, too.
        alpha: also denoise the alpha of frames, with the kernels of a method that has kernels, and by its own noise.
            The color stays a pair with it, also at the rim of what it covers.
        wrap: frames are panoramas of 360 degrees: the image continues at its left and right border with the other one,
            so that there is no seam. Cameras are not used, as a matrix describes no panorama; the motion of a pixel may
            lead over the border.
        settings: arguments for the model's constructor, such as ``alpha_min=0.2``; see the model's own page.

    Raises:
        InputError: the model is unknown, has no weights or no such setting, the device is not available, the precision
            is unknown, ``tile`` or ``max_memory`` is invalid, or the model cannot be computed in tiles.

    Example:
        >>> denoiser = Denoiser("wild_small")
        >>> frame = Frame(color=torch.rand(1, 3, 24, 32), depth=torch.ones(1, 1, 24, 32))
        >>> denoiser(frame).shape
        torch.Size([1, 3, 24, 32])
        >>> denoiser.report.missing
        ['albedo', 'motion', 'normal']
    """

    def __init__(
        self,
        model: str | Model | nn.Module | None = None,
        *,
        weights: Path | str | None = None,
        device: torch.device | str = "cpu",
        precision: AskedPrecision = "auto",
        keep_all: bool = False,
        tile: int | None = None,
        max_memory: float | None = None,
        differentiable: bool = False,
        alpha: bool = False,
        wrap: bool = False,
        **settings: Any,
    ) -> None:
        check_kind("weights", weights, (str, Path, NoneType), "a path")
        check_kind("tile", tile, (int, NoneType), "a whole number of pixels")
        check_kind("max_memory", max_memory, (int, float, NoneType), "a number of GB")
        switches = {"keep_all": keep_all, "differentiable": differentiable, "alpha": alpha, "wrap": wrap}
        for name, switch in switches.items():
            check_kind(name, switch, (bool,), "True or False")
        self.device = usable_device(device)
        check_choice("precision", precision, AskedPrecision)
        self.keep_all, self.differentiable, self.alpha, self.wrap = keep_all, differentiable, alpha, wrap
        self._report, self._times = FrameReport(), Times(self.device)
        # Whether the last frame whose noise is known has enough of it to be computed in bfloat16.
        self._rounds = False
        # Set by a caller that never writes into a frame again after passing it: then no buffer is copied.
        self.frames_stay = False
        # Unset by a caller that shows what the reports doubt.
        self.warns = True
        if model is None:
            model = DEFAULT if weights is None else model_of(Path(weights))
        name, of_zoo = str(model), isinstance(model, str) and ":" not in model
        if isinstance(model, str):
            check_settings(model, settings, of=Denoiser)
            model = create_model(model, pretrained=weights is None, weights=weights, **settings)
        elif settings or weights is not None:
            names = ", ".join([*settings, *(["weights"] if weights else [])])
            raise InputError(f"{names}: expected a model's name, found a model")
        if isinstance(model, nn.Module):
            # Channels-last convolutions are about 1.5 times faster on a CPU.
            model.to(self.device, memory_format=torch.channels_last).eval()  # type: ignore[call-overload]
        self.model = as_model(model)
        self._name = name if of_zoo else name_of(self.model)
        self.precision, self._why_precision = self._chosen(precision, of_zoo=of_zoo)
        self._tiles = Division(self.model, tile, max_memory, self.device)
        self.reset()

    def _chosen(self, asked: AskedPrecision, *, of_zoo: bool) -> Chosen:
        if asked != "auto":
            return Chosen(asked, "asked for")
        if self.differentiable:
            return Chosen("float32", "derivatives are wanted")
        if not of_zoo:
            return Chosen("float32", "what bfloat16 rounds in a model of your own is for you to judge")
        if has_network(self.model):
            return fastest_precision(self.device)
        return Chosen("float32", "nothing is learnt")

    @in_turn
    def reset(
        self,
        buffers: Collection[str] | None = None,
        frames: int | None = None,
        size: tuple[int, int] | None = None,
        layers: int = 0,
    ) -> None:
        """Discard the history: the next frame begins a shot. A cut and a change of size do this automatically.

        So does, for a method that divides light by the albedo, an albedo that only one of two successive frames has.

        Args:
            buffers: names of the buffers that every frame of the shot will have, if they are known.
            frames: number of frames of the shot, if it is known.
            size: their height and width, if it is known together with the buffers. Then ``has_room_ahead`` tells
                whether memory allows reading the next frame while one is denoised.
            layers: number of layers of every frame.

        Raises:
            InputError: frames of this size cannot be denoised within ``max_memory``; the message says how much is
                needed.
        """
        check_kind("frames", frames, (int, NoneType), "a whole number")
        check_kind("layers", layers, (int,), "a whole number")
        self._state: State = None
        # The state that the last frame continued.
        self._before: State = None
        self._watch, self._doubted = Watch(), False
        self._shape: tuple[int, ...] = ()
        self._layers: tuple[str, ...] = ()
        # Whether the last frame had an albedo.
        self._with_albedo = False
        self._count, self._frames, self._buffers = 0, frames, buffers
        # A single frame has no next one to read.
        self.has_room_ahead = size is not None and frames != 1
        if buffers is not None and size is not None:
            streaming = self.has_history(buffers)
            # One more for the remainder.
            carried = layers + (layers > 0) + (self.alpha and "alpha" in buffers)
            size = (size[0], size[1] + 2 * seam(size[1])) if self.wrap else size
            shot = Frames(size, frozenset(buffers) - (frozenset() if streaming else MOTION), streaming, carried=carried)
            shot = shot._replace(bfloat16=self.precision != "float32")
            self.has_room_ahead = self._tiles.has_room_ahead(shot) and self.has_room_ahead

    @property
    @in_turn
    def report(self) -> FrameReport:
        """The report of the last frame. On a GPU, this waits until the frame is done.

        Raises:
            InputError: on a GPU, the error that the call would raise on a CPU: the frame was invalid. The history is
                reset.
        """
        self._settle()
        return self._report

    @in_turn
    def detach(self) -> None:
        """Detach the history from the graph, for truncated backpropagation: later ``backward`` ends here."""
        self._state, self._before = pytree.tree_map_only(Tensor, Tensor.detach, (self._state, self._before))

    def has_history(self, buffers: Collection[str]) -> bool:
        """Whether frames with these buffers can have a history; otherwise motion is not needed."""
        return self.keep_all or (self._frames != 1 and tells_motion(buffers))

    def __call__(self, frame: Frame) -> Tensor:
        """Denoise the next frame of the shot.

        Args:
            frame: a renderer's outputs, any float dtype. Values of ``color`` that are NaN, infinite, negative or above
                1e16 are replaced and counted (:func:`mcdenoise.light.replace_invalid`), with a warning if the light
                changes by more than 1 %. Layers are used by :meth:`output` only. The denoiser keeps no reference
                to the buffers, so the next frame may be written into them.

        Returns:
            ``(B, 3, H, W)`` float32 (or float64, see ``differentiable``) scene-linear radiance on the denoiser's
            device, in its own memory; ``report`` holds the details.

        Raises:
            InputError: a buffer that the model needs is missing; a buffer holds NaN, an illegal infinity or a value far
                out of range; the result is not finite; or memory is insufficient, see :meth:`reset`. After an error the
                history is that of the previous frame. On a GPU, for which the call does not wait, invalid values are
                reported by the next call or by ``report``, and the history is reset.
        """
        check_kind("frame", frame, (Frame,), "a Frame, such as Frame(color=...)")
        return self._step(frame.replace(layers={}) if frame.layers else frame, stages=False).image

    def output(self, frame: Frame, *, stages: bool = True) -> Output:
        """Denoise the next frame, and also return stages, layers and alpha.

        Args:
            frame: see :meth:`__call__`. ``frame.layers`` may hold any parts of the color, with the same names in all
                frames of a shot; a negative or infinite value in a layer makes its pixel invalid.
            stages: whether to return the intermediate images, beginning with ``noisy``.

        Returns:
            The image, the stages, a denoised layer for each of the frame's, and the alpha if the denoiser was created
            with ``alpha``. If the frame's layers add up to ``color``, the denoised layers add up to the image. The
            stage ``layers`` of the report tells how they were denoised: with the kernels of the color, or, for a method
            without kernels, by splitting its image.

        Raises:
            InputError: see :meth:`__call__`; or layers are not parts of the color, or their names have changed.
        """
        return self._step(frame, stages=stages)

    @in_turn
    def _step(self, frame: Frame, *, stages: bool) -> Output:
        check_kind("frame", frame, (Frame,), "a Frame, such as Frame(color=...)")
        started.add(os.getpid())
        self._settle()
        self._report = report = FrameReport(precision=self._why_precision)
        self._times = times = Times(self.device)
        with nullcontext() if self.differentiable else torch.no_grad():
            with times.of("validate"):
                if frame.color.is_meta and self.device.type != "meta":
                    raise InputError("frame: expected tensors with values, found those of the device meta, without any")
                given, dtype = frame, dtype_of(frame, self.model, differentiable=self.differentiable)
                hints = Hints(last=self._is_last(), alone=self._frames == 1, stages=stages)
                hints = hints._replace(keep_all=self.keep_all, alpha=self.alpha or frame.hints.alpha)
                whole = frame.to(self.device).to(dtype).replace(hints=hints)
                whole = wrapped(whole) if self.wrap else whole
                frame, void = prepared(whole, report, self._doubt)
                self._check_layers(frame)
                report.missing = absent_buffers(self.model, frame)
                precision, report.tiles = self._planned(frame, report)
                # A depth by way of the camera says nothing about this camera.
                shown = frame.replace(depth=frame.depth if given.depth is not None else None)
                before, watch = self._continued(shown, report)
            noisy = frame.color
            computing = computing_in(precision, self.device)
            with (
                computing,
                explained(self.model, dtype),
                times.of(self._name),
                times.of_modules(stages_of(self.model, self._name)),
            ):
                output, state = checked_step(self.model, frame, before, self._shape, report.ask)
            with times.of("validate"):
                # A renderer may write its next frame into the same buffers, and a user may change an image in place.
                state = state if self.frames_stay else owned(state, [given, noisy])
                if stages:
                    output = output._replace(stages={"noisy": noisy, **output.stages})
                output = completed(frame, output._replace(image=output.image.to(dtype)))
                output = with_void(output, whole, void)
                output = unwrapped(output, given.size[1]) if self.wrap else output
                report.add(output.notes)
                output = opened(output)._replace(notes=())
                result: Output = owned(output, [given, noisy, state])
            report.send()
        if at_hand(self.device):
            report.milliseconds = times.milliseconds()
        # Only now, so that a rejected frame does not change the state.
        self._state, self._shape, self._count = state, tuple(frame.color.shape), self._count + 1
        self._layers, self._with_albedo = self._carried(frame), frame.albedo is not None
        self._before, self._watch = None if watch.pixels is None else before, watch
        return result

    def _continued(self, frame: Frame, report: FrameReport) -> tuple[State, Watch]:
        """The state that a frame continues, and what is remembered of it; warns of wrong motion in the first frames.

        Where it repeats the noise of the frame before, it takes that frame's place in the history: equal noise counts
        once. On a GPU, which would have to be waited for, neither is looked for.
        """
        follows = at_hand(self.device) and self.has_history(frame.buffers)
        moves = bool(MOTION & (self.model.needs.buffers | self.model.needs.uses))
        watch, repeats, doubt = self._watch.after(
            frame, motion=follows and moves and self.warns, noise=follows and not self.keep_all
        )
        if doubt:
            warnings.warn(doubt, stacklevel=level_of_caller())
        if self._with_albedo != (frame.albedo is not None) and any(parts_of(self.model, Demodulated)):
            # Light that was divided by an albedo, and light that was not, have no common history.
            return None, watch
        if repeats:
            report.repeats = REPEATED
            self._doubt(report.repeats)
            return self._before, watch
        # Before a network runs, so that it has the memory.
        self._before = None
        return self._state, watch

    def _doubt(self, text: str) -> None:
        """Warn of changed light or equal noise, once a shot."""
        if text and self.warns and not self._doubted:
            self._doubted = True
            warnings.warn(text, stacklevel=level_of_caller())

    def _settle(self) -> None:
        """Complete the report of the last frame; discard the history if that frame was invalid."""
        try:
            self._report.settle()
            self._report.milliseconds = self._report.milliseconds or self._times.milliseconds()
        except InputError as error:
            self._state, self._shape, self._layers = None, (), ()
            self._before, self._watch = None, self._watch._replace(pixels=None)
            raise InputError(f"{error} (of the last frame, told a frame late; the history begins anew)") from error

    def _check_layers(self, frame: Frame) -> None:
        if self._state is not None and self._layers != self._carried(frame):
            before, now = (
                ", ".join(name for name in names if name != REST) or "none"
                for names in (self._layers, self._carried(frame))
            )
            raise InputError(f"layers: expected those of the frame before, {before}, found {now}; reset the denoiser")

    def _carried(self, frame: Frame) -> tuple[str, ...]:
        """Names of the channels that are accumulated together with the color."""
        return (*frame.layers, *(() if alpha_of(frame) is None else ("alpha",)))

    def _planned(self, frame: Frame, report: FrameReport) -> tuple[Precision, str]:
        """The precision of a frame, and its tiles, in words.

        Raises:
            InputError: not even the smallest tiles fit.
        """
        streaming, carried = self.has_history(frame.buffers), len(self._carried(frame))
        shot = Frames(frame.size, frame.buffers, streaming, self.has_room_ahead, frame.color.shape[0], carried)
        if self.precision == "bfloat16":

            def hear(levels: Sequence[float]) -> None:
                self._rounds = min(levels) > _ROUNDED

            # A GPU tells it when the next frame comes.
            report.ask(noise_of(frame.color, frame.albedo, frame.normal).level, hear)
            # A GPU told it of the frame before, and before the first one of a shot there is none.
            if not self._rounds or not (self._count or at_hand(self.device)):
                # Less memory than float32 needs may have been allowed.
                with suppress(InputError):
                    tiles = self._tiles.divide(shot)
                    report.precision = "float32, since the frame has hardly any noise, and bfloat16 would add some"
                    return "float32", tiles
        return self.precision, self._tiles.divide(shot._replace(bfloat16=self.precision != "float32"))

    def _is_last(self) -> bool:
        """Whether no later frame can have a history."""
        ends = self._frames is not None and self._count + 1 >= self._frames
        return ends or (self._buffers is not None and not self.has_history(self._buffers))
