"""Denoising frame by frame, with a history; and denoising of a single image from arrays to an array."""

from __future__ import annotations

import functools
import inspect
import os
import reprlib
import threading
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from types import NoneType
from typing import Any, Concatenate, Literal, ParamSpec, TypeVar, get_args
from weakref import WeakKeyDictionary

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from mcdenoise.errors import InputError, did_you_mean, level_of_caller
from mcdenoise.frame import MOTION, OF_RENDERERS, Frame, Hints, Layout, tells_motion
from mcdenoise.models import (
    DEFAULT,
    EXACT,
    FILTERED,
    Model,
    Note,
    Output,
    State,
    computing_in,
    create_model,
    fastest_precision,
    find_model,
    has_network,
)
from mcdenoise.models._adapter import as_model
from mcdenoise.models._contract import absent_buffers, checked_step, owned
from mcdenoise.models._layers import REST, alpha_of, closed, completed, opened
from mcdenoise.models._memory import Division, Frames, check_limits
from mcdenoise.models._precision import Chosen, Precision
from mcdenoise.models._reads import at_hand
from mcdenoise.models._report import FrameReport
from mcdenoise.models._times import Times
from mcdenoise.models._void import Void, with_void, without_void
from mcdenoise.models._weights import model_of
from mcdenoise.models._wrapped import seam, unwrapped, wrapped
from mcdenoise.models._wrapper import name_of
from mcdenoise.motion import MOTION_PAIRS, Seen, doubt_motion, seen_in
from mcdenoise.noise import noise_is_repeated, noise_of, thinned
from mcdenoise.sampling import has_exact_features

AskedPrecision = Literal["auto", "float32", "bfloat16"]

# Level of noise up to which bfloat16 makes errors larger: by 41 % at 0.001, 6 % at 0.006, 2 % at 0.02, 1 % at 0.06
# (oidn_tuned on even surfaces, where they are largest).
_ROUNDED = 0.03
# Level of noise of frames with some eight samples a pixel; training/README.md has the errors of both models.
_MANY_SAMPLES = 0.1


_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")
# The locks are not in the denoisers, which can be copied to another process.
_locks: WeakKeyDictionary[Denoiser, threading.RLock] = WeakKeyDictionary()
# The process, if it has denoised frames, and so may have started threads of torch.
_started: set[int] = set()


def _in_turn(
    method: Callable[Concatenate[Denoiser, _Arguments], _Result],
) -> Callable[Concatenate[Denoiser, _Arguments], _Result]:
    """Run a denoiser's methods in one thread at a time."""

    @functools.wraps(method)
    def alone(denoiser: Denoiser, /, *arguments: _Arguments.args, **settings: _Arguments.kwargs) -> _Result:
        with _locks.setdefault(denoiser, threading.RLock()):
            return method(denoiser, *arguments, **settings)

    return alone


def _after_fork() -> None:
    """Make a forked process independent of its parent's threads: it has none of them, and would wait for them."""
    _locks.clear()
    if _started:
        torch.set_num_threads(1)
    _started.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


class Denoiser:
    """Denoises the frames of a shot one after the other, and keeps the method's state.

    The motion of the first frames of a shot is examined, on a CPU: a warning tells the likely mistake if another
    convention fits the frames clearly better.

    Denoisers in several threads do not affect one another. Frames that several threads give to one denoiser are
    denoised one after the other, as one shot in the order of their arrival; ``report`` is that of the last of them.

    Args:
        model: the name of a model in the zoo (its shipped weights are loaded), your own ``path/to/file.py:factory`` or
            ``package.module:factory``, a :class:`mcdenoise.models.Model`, or a module or function whose parameters are
            named like buffers, see :class:`mcdenoise.models.FromBuffers`. A module of yours is moved to the device,
            made channels-last and put into evaluation mode. By default it is the one that the weights are for; without
            weights, the first frame chooses it, once, as in `mcdenoise denoise` (:func:`suitable_model`), and the
            report says which and why. Until then the attribute ``model`` is ``None``; see :meth:`pick`.
        weights: a safetensors file of other weights for a model given by name.
        device: device to run on. Frames may come from any device; images are returned on this one.
        precision: precision of convolutions; everything else stays in float32. ``"bfloat16"`` is about twice as fast on
            processors that support it; frames with hardly any noise, which it would make worse, are computed in float32
            all the same (on a GPU by the noise of the frame before, and the first one always). ``"auto"`` chooses it
            for a trained model of the zoo if it is faster on this machine (see
            :func:`mcdenoise.models.fastest_precision`), and float32 otherwise: for a model of yours, and with
            ``differentiable``. The attribute ``precision`` holds the chosen precision, and the report the reason.
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
        >>> denoiser = Denoiser("cascaded_v2_micro")
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
        _check_kind("weights", weights, (str, Path, NoneType), "a path")
        _check_kind("tile", tile, (int, NoneType), "a whole number of pixels")
        _check_kind("max_memory", max_memory, (int, float, NoneType), "a number of GB")
        for name, switch in (
            ("keep_all", keep_all),
            ("differentiable", differentiable),
            ("alpha", alpha),
            ("wrap", wrap),
        ):
            _check_kind(name, switch, (bool,), "True or False")
        self.device = _device(device)
        known = get_args(AskedPrecision)
        if precision not in known:
            raise InputError(f"precision: expected one of {', '.join(known)}, found '{precision}'")
        self.keep_all, self.differentiable, self.alpha, self.wrap = keep_all, differentiable, alpha, wrap
        self._picked = ""
        self._asked, self._given, self._limits = precision, settings, (tile, max_memory)
        if model is None and weights is not None:
            model = model_of(Path(weights))
        self._report, self._times = FrameReport(), Times(self.device)
        # Whether the last frame whose noise is known has enough of it to be computed in bfloat16.
        self._rounds = False
        # Set by a caller that never writes into a frame again after passing it: then no buffer is copied.
        self.frames_stay = False
        # Unset by a caller that shows what the reports doubt.
        self.warns = True
        # A Model, or None until the first frame has picked one.
        self.model: Any = None
        if model is None:
            _check_settings(DEFAULT, settings)
            check_limits(tile, max_memory, self.device)
            self.precision, self._why_precision = self._chosen()
        else:
            self._make(model, weights)
        self.reset()

    def _make(self, model: str | Model | nn.Module, weights: Path | str | None = None) -> None:
        """Make the model and what depends on it."""
        name, of_zoo = str(model), isinstance(model, str) and ":" not in model
        if isinstance(model, str):
            _check_settings(model, self._given)
            model = create_model(model, pretrained=weights is None, weights=weights, **self._given)
        elif self._given or weights is not None:
            names = ", ".join([*self._given, *(["weights"] if weights else [])])
            raise InputError(f"{names}: expected a model's name, found a model")
        if isinstance(model, nn.Module):
            # Channels-last convolutions are about 1.5 times faster on a CPU.
            model.to(self.device, memory_format=torch.channels_last).eval()  # type: ignore[call-overload]
        self.model = as_model(model)
        self._name = name if of_zoo else name_of(self.model)
        self.precision, self._why_precision = self._chosen(of_zoo=of_zoo)
        self._tiles = Division(self.model, *self._limits, self.device)

    @_in_turn
    def pick(self, frame: Frame | None) -> None:
        """Choose the model by a frame, if none was named or chosen before; otherwise the first frame does so.

        Args:
            frame: any of the shot, or ``None`` for features that are known to be filtered, see :func:`suitable_model`.

        Raises:
            InputError: the chosen model cannot be made with the settings, or memory is insufficient.
        """
        if self.model is None:
            with torch.no_grad():
                name, why = suitable_model(frame, still=self._frames == 1, cascade=bool(self._given))
            # Weights can be trained later, also if the caller infers only now.
            with self._times.of("pick"), torch.inference_mode(False), torch.enable_grad():
                self._make(name)
            self._picked = f"{name}: {why}"
            self._plan()

    def _chosen(self, *, of_zoo: bool = True) -> Chosen:
        if self._asked != "auto":
            return Chosen(self._asked, "asked for")
        if self.differentiable:
            return Chosen("float32", "derivatives are wanted")
        if not of_zoo:
            return Chosen("float32", "what bfloat16 rounds in a model of your own is for you to judge")
        # Every model that is picked has a network.
        if self.model is None or has_network(self.model):
            return fastest_precision(self.device)
        return Chosen("float32", "nothing is learnt")

    @_in_turn
    def reset(
        self,
        buffers: Collection[str] | None = None,
        frames: int | None = None,
        size: tuple[int, int] | None = None,
        layers: int = 0,
    ) -> None:
        """Discard the history: the next frame begins a shot. A cut and a change of size do this automatically.

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
        _check_kind("frames", frames, (int, NoneType), "a whole number")
        _check_kind("layers", layers, (int,), "a whole number")
        self._state: State = None
        self._doubted = False
        # The state that the last frame continued, and a few of its pixels.
        self._before: State = None
        self._seen: Frame | None = None
        # What the next frame's motion is compared with, and how many frames are still examined.
        self._compared: Seen | None = None
        self._unseen = 1 + MOTION_PAIRS
        self._shape: tuple[int, ...] = ()
        self._layers: tuple[str, ...] = ()
        self._count, self._frames, self._buffers = 0, frames, buffers
        self._size, self._expected_layers = size, layers
        self._plan()

    def _plan(self) -> None:
        """Foresee the memory of the shot, as far as it is known."""
        size, buffers, layers = self._size, self._buffers, self._expected_layers
        # A single frame has no next one to read.
        self.has_room_ahead = size is not None and self._frames != 1 and self.model is not None
        if buffers is not None and size is not None and self.model is not None:
            streaming = self.has_history(buffers)
            # One more for the remainder.
            carried = layers + (layers > 0) + (self.alpha and "alpha" in buffers)
            size = (size[0], size[1] + 2 * seam(size[1])) if self.wrap else size
            shot = Frames(size, frozenset(buffers) - (frozenset() if streaming else MOTION), streaming, carried=carried)
            shot = shot._replace(bfloat16=self.precision != "float32")
            self.has_room_ahead = self._tiles.has_room_ahead(shot) and self.has_room_ahead

    @property
    @_in_turn
    def report(self) -> FrameReport:
        """The report of the last frame. On a GPU, this waits until the frame is done.

        Raises:
            InputError: on a GPU, the error that the call would raise on a CPU: the frame was invalid. The history is
                reset.
        """
        self._settle()
        return self._report

    @_in_turn
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
        _check_kind("frame", frame, (Frame,), "a Frame, such as Frame(color=...)")
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

    @_in_turn
    def _step(self, frame: Frame, *, stages: bool) -> Output:
        _check_kind("frame", frame, (Frame,), "a Frame, such as Frame(color=...)")
        _started.add(os.getpid())
        self._settle()
        self._report = report = FrameReport(precision=self._why_precision)
        self._times = times = Times(self.device)
        with nullcontext() if self.differentiable else torch.no_grad():
            with times.of("validate"):
                if frame.color.is_meta and self.device.type != "meta":
                    raise InputError(
                        "frame: expected tensors with values, found tensors of the device meta, without any"
                    )
                given, dtype = frame, self._dtype(frame)
                hints = Hints(
                    last=self._is_last(),
                    alone=self._frames == 1,
                    stages=stages,
                    keep_all=self.keep_all,
                    alpha=self.alpha,
                )
                whole = frame.to(self.device).to(dtype).replace(hints=hints)
                whole = wrapped(whole) if self.wrap else whole
                frame, void = self._prepared(whole, report)
                if self.model is None:
                    self.pick(frame)
                report.model = self._picked
                # A depth by way of the camera says nothing about this camera.
                compared = self._examined(frame.replace(depth=frame.depth if given.depth is not None else None))
                self._check_layers(frame)
                report.missing = absent_buffers(self.model, frame)
                precision, report.tiles = self._planned(frame, report)
                before, seen = self._continued(frame, report)
            noisy = frame.color
            computing = computing_in(precision, self.device)
            with computing, self._explained(dtype), times.of(self._name), times.of_modules(self.model, self._name):
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
        self._layers = self._carried(frame)
        self._before, self._seen = (None, None) if seen is None else (before, seen)
        self._compared, self._unseen = compared, max(self._unseen - 1, 0)
        return result

    def _prepared(self, frame: Frame, report: FrameReport) -> tuple[Frame, Void]:
        """The frame with valid values, void pixels filled, and layers that sum to its color."""
        filled, void = without_void(frame)
        if void.mask is not None:
            report.add([Note("void", "filled from around, and kept")])
        return closed(self._inspected(filled, report).with_depth(), report.ask), void

    def _inspected(self, frame: Frame, report: FrameReport) -> Frame:
        """The frame with valid values. An invalid one raises an error, on a GPU only when the numbers have arrived."""
        if at_hand(self.device):
            frame, report.repairs, _ = frame.inspect()
            self._doubt(report.repairs.doubt)
            return frame
        repaired = frame.repaired()

        def judge(numbers: Sequence[float]) -> None:
            report.repairs = repaired.judge(numbers)
            self._doubt(report.repairs.doubt)

        report.ask(repaired.numbers, judge)
        return repaired.frame

    def _continued(self, frame: Frame, report: FrameReport) -> tuple[State, Frame | None]:
        """The state that a frame continues, and its pixels to compare the next one with.

        Where it repeats the noise of the frame before, it takes that frame's place in the history: equal noise counts
        once. On a GPU, which is not read, and with ``keep_all`` this is not looked for.
        """
        watches = at_hand(self.device) and self.has_history(frame.buffers) and not self.keep_all
        seen = thinned(frame) if watches else None
        if seen is None or self._seen is None or not noise_is_repeated(frame, seen, self._seen):
            # Before a network runs, so that it has the memory.
            self._before = None
            return self._state, seen
        report.repeats = (
            "the noise is that of the frame before, pixel by pixel, and counts once, as it does only on a CPU where "
            "nothing moves; render each frame with its own seed"
        )
        self._doubt(report.repeats)
        return self._before, seen

    def _examined(self, frame: Frame) -> Seen | None:
        """Warn of wrong motion in one of the first frames of a shot, and return what that of the next one needs.

        Nothing is examined on a GPU, which would have to be waited for, nor for a method that uses no motion.
        """
        wanted = MOTION & (self.model.needs.buffers | self.model.needs.uses)
        if not (self._unseen and self.warns and wanted and self.has_history(frame.buffers) and at_hand(self.device)):
            return None
        if not (doubt := doubt_motion(frame, self._compared)):
            return seen_in(frame)
        self._unseen = 0
        warnings.warn(doubt, stacklevel=level_of_caller())
        return None

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
            self._before = self._seen = None
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

    @contextmanager
    def _explained(self, dtype: torch.dtype) -> Iterator[None]:
        """Add an explanation to the error of a model whose weights have a higher precision than its frame."""
        try:
            yield
        except RuntimeError as error:
            weights = list(self.model.parameters()) if isinstance(self.model, nn.Module) else []
            if dtype == torch.float64 or all(each.dtype != torch.float64 for each in weights):
                raise
            raise InputError(
                f"model: expected float32 weights for float32 frames, found float64 weights, with which it fails "
                f"({' '.join(str(error).split())}); call its float(), or pass float64 frames with differentiable"
            ) from error

    def _dtype(self, frame: Frame) -> torch.dtype:
        if self.model is None:
            return torch.float32
        exact = self.differentiable and frame.color.dtype == torch.float64
        weights = self.model.parameters() if isinstance(self.model, nn.Module) else ()
        return torch.float64 if exact and all(each.dtype == torch.float64 for each in weights) else torch.float32

    def _planned(self, frame: Frame, report: FrameReport) -> tuple[Precision, str]:
        """The precision of a frame, and its tiles, in words.

        Raises:
            InputError: not even the smallest tiles fit.
        """
        shot = self._shot(frame)
        if self.precision == "bfloat16":

            def hear(levels: Sequence[float]) -> None:
                self._rounds = min(levels) > _ROUNDED

            # A GPU tells it when the next frame comes.
            report.ask(noise_of(frame.color, frame.albedo, frame.normal).level, hear)
            if not self._rounds:
                # Less memory than float32 needs may have been allowed.
                with suppress(InputError):
                    tiles = self._tiles.divide(shot)
                    report.precision = "float32, since the frame has hardly any noise, and bfloat16 would add some"
                    return "float32", tiles
        return self.precision, self._tiles.divide(shot._replace(bfloat16=self.precision != "float32"))

    def _shot(self, frame: Frame) -> Frames:
        streaming = self.has_history(frame.buffers)
        batch, carried = frame.color.shape[0], len(self._carried(frame))
        return Frames(frame.size, frame.buffers, streaming, self.has_room_ahead, batch, carried)

    def _is_last(self) -> bool:
        """Whether no later frame can have a history."""
        if self._frames is not None and self._count + 1 >= self._frames:
            return True
        return self._buffers is not None and not self.has_history(self._buffers)


def suitable_model(frame: Frame | None, *, still: bool = False, cascade: bool = False) -> tuple[str, str]:
    """The name of the model that suits a frame, and the reason in words.

    ``cascaded_v2`` was trained on features without noise and one sample a pixel, and is best with a history;
    ``oidn_tuned_exact`` was trained on features without noise and 1 to 64 samples. Files of a renderer have features
    through a pixel filter, for which the others were trained.

    Args:
        frame: ``None`` for one that is known to have features through a filter.
        still: whether it is the only frame of its shot.
        cascade: whether a cascade is required, for the settings of its history.
    """
    exact = frame is not None and has_exact_features(frame)
    if cascade:
        return DEFAULT if exact else "cascaded_v3", "of the usual models, only cascades have settings of the history"
    name, reason = FILTERED, "features may be noisy, or filtered over pixels"
    if frame is not None and exact:
        if not still and float(noise_of(frame.color, frame.albedo, frame.normal).level.amax()) > _MANY_SAMPLES:
            return DEFAULT, "features have no noise, and the color of a sequence has much"
        name, reason = EXACT, f"features have no noise, and the color {'is of a still' if still else 'has little'}"
    return name, f"{reason}; oidn_temporal usually has a smaller error, but takes longer"


def denoise(
    color: ArrayLike,
    *,
    layout: Layout = "HWC",
    albedo: ArrayLike | None = None,
    normal: ArrayLike | None = None,
    depth: ArrayLike | None = None,
    model: str | Model | nn.Module | None = None,
    device: torch.device | str = "cpu",
    precision: AskedPrecision = "auto",
    extra: Mapping[str, ArrayLike] | None = None,
    **others: Any,
) -> NDArray[np.float32]:
    """Denoise a single image: arrays in, an array out.

    The model is created in each call, and no state is kept. For the frames of a shot, which have a history, and for
    many images use a :class:`Denoiser` and :meth:`mcdenoise.Frame.from_numpy`.

    Args:
        color: ``(H, W, 3)`` in the layout ``"HWC"``, ``(3, H, W)`` in ``"CHW"``, or one channel, also ``(H, W)``, which
            is grey: scene-linear radiance of any float dtype. Pixels that are NaN, infinite, negative or above 1e16 are
            replaced, see :class:`Denoiser`.
        layout: layout of every array, including the result. It is never guessed: an array of another layout is
            rejected.
        albedo: like ``color``, in [0, 1]; this and the following buffers are optional.
        normal: like ``color``, in [-1, 1].
        depth: ``(H, W)``, or with a channel axis.
        model: see :class:`Denoiser`, also for the default.
        device: device to run on; the result is copied back from it.
        precision: see :class:`Denoiser`.
        extra: further buffers by name.
        others: further buffers of :class:`mcdenoise.Frame`, such as ``position``, see
            :meth:`mcdenoise.Frame.from_numpy`; further arguments of :class:`Denoiser`, such as ``weights``; and
            settings of the model.

    Returns:
        The denoised image, float32 whatever the dtype of ``color``, in the same layout and with as many channels,
        contiguous, in its own memory.

    Raises:
        InputError: an array has another layout, size or number of channels, holds no floats or illegal values, or the
            model lacks a buffer or has no such setting; the message names it.

    Example:
        >>> noisy, albedo = np.random.rand(24, 32, 3), np.full((24, 32, 3), 0.5)
        >>> clean = denoise(noisy, albedo=albedo, model="cascaded_v2_micro")
        >>> clean.shape, clean.dtype
        ((24, 32, 3), dtype('float32'))
    """
    settings = {name: value for name, value in others.items() if name not in OF_RENDERERS}
    buffers = {name: value for name, value in others.items() if name in OF_RENDERERS}
    frame = Frame.from_numpy(color, layout=layout, albedo=albedo, normal=normal, depth=depth, extra=extra, **buffers)
    _check_settings(model or DEFAULT, settings, also={*OF_RENDERERS, *inspect.signature(denoise).parameters})
    denoiser = Denoiser(model, device=device, precision=precision, **settings)
    denoiser.reset(frames=1)
    image: NDArray[np.float32] = denoiser(frame)[0].cpu().numpy()
    # Raises an error for invalid values, which a GPU reports late.
    denoiser._settle()
    shape = np.shape(color)
    if len(shape) == 2 or shape[-1 if layout == "HWC" else 0] == 1:
        return np.ascontiguousarray(image.mean(0).reshape(shape))
    return np.ascontiguousarray(image if layout == "CHW" else image.transpose(1, 2, 0))


def _check_settings(model: object, given: Iterable[str], *, also: Collection[str] = ()) -> None:
    """Refuse an argument by its name if nothing takes it; its value, which may be a large array, is not shown.

    Args:
        model: see :class:`Denoiser`. The settings of a model by the user are checked when it is created.
        given: names of arguments that should be settings of the model.
        also: names of buffers and arguments that the caller takes, too.
    """
    settings: Sequence[str] = ()
    if isinstance(model, str):
        if ":" in model:
            return
        parameters = inspect.signature(find_model(model).construct).parameters
        if any(each.kind is each.VAR_KEYWORD for each in parameters.values()):
            return
        settings = list(parameters)
    arguments = inspect.signature(Denoiser).parameters.keys() - {"settings"}
    places = [*(["a buffer"] if also else []), "an argument of Denoiser"]
    places += [f"a setting of model '{model}' ({', '.join(settings)})"] if settings else []
    for name in given:
        if name not in settings and name not in arguments:
            near = did_you_mean(name, {*also, *arguments, *settings})
            raise InputError(
                f"argument '{name}': expected {' or '.join(places)}, found none of this name{near and '; '}{near}"
            )


def _check_kind(name: str, value: object, kinds: tuple[type, ...], expected: str) -> None:
    # Python counts True and False as integers; here they are not.
    if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
        raise InputError(f"{name}: expected {expected}, found {type(value).__name__} {reprlib.repr(value)}")


def _device(device: torch.device | str) -> torch.device:
    try:
        device = torch.device(device)
        torch.zeros((), device=device).item()
    except (RuntimeError, AssertionError, ImportError, TypeError) as error:
        raise InputError(
            f"device '{device}': expected one that torch can use, found: {str(error).splitlines()[0]}"
        ) from error
    return device
