"""Streaming denoising: a frame in, a clean image out."""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor, nn

from mcdenoise.buffers import OF_THE_PAST, Frame, Inspected
from mcdenoise.errors import InputError
from mcdenoise.history import Accumulated, History
from mcdenoise.models import Denoised, Known, Region, create_model
from mcdenoise.ops import Accumulate, HistoryLag, remodulate
from mcdenoise.ops._rows import by_rows
from mcdenoise.plan import Plan, Shortcut, Stage, Steps
from mcdenoise.tiling import GB, Frames, Memory, Network, Tiling, check_side, describe

Precision = Literal["float32", "bfloat16"]
PRECISIONS: tuple[Precision, ...] = ("float32", "bfloat16")


@dataclass
class FrameReport:
    """What happened to one frame.

    Args:
        reset: why the history was thrown away, or ``""`` where it was used.
        replaced_pixels: pixels of the noisy color that were NaN, infinite, negative or above 1e16.
        missing: features that the network takes and the frame has not; it sees a constant instead.
        milliseconds: run time of each stage: validate, plan, accumulate, network, remodulate; of a sequence also of
            waiting for the disk, to have read this frame and to have written the last one.
        beside: milliseconds of what is done while another frame is denoised: read, write.
        stages: what was left out of them, and why.
        tiles: the parts of the image on which the network ran, and why those.
    """

    reset: str = ""
    replaced_pixels: int = 0
    missing: list[str] = field(default_factory=list)
    milliseconds: dict[str, float] = field(default_factory=dict)
    beside: dict[str, float] = field(default_factory=dict)
    stages: list[Stage] = field(default_factory=list)
    tiles: str = ""


@dataclass
class Images:
    """What a denoiser knows of one frame, all ``(B, 3, H, W)`` scene-linear radiance with albedo.

    Args:
        noisy: the frame's color, with invalid pixels replaced.
        accumulated: with the history blended in.
        initial: result of the cascade's first network.
        denoised: the final image.
    """

    noisy: Tensor
    accumulated: Tensor
    initial: Tensor
    denoised: Tensor


class Denoiser:
    """Denoises the frames of a shot one after the other: accumulate, demodulate, network, remodulate.

    Args:
        model: a model's name in the zoo (its shipped weights are loaded), or a module that takes demodulated color,
            albedo, normal and depth and returns :class:`mcdenoise.models.Denoised`; with an attribute ``takes_history``
            that is true, it also gets ``current`` and ``length`` of :class:`mcdenoise.history.Accumulated`, and with
            ``takes_plan``, ``guides``, ``known`` and ``parts``, see :class:`mcdenoise.models.Cascade`, whose ``halo``,
            ``parts`` and ``bytes_per_pixel`` it has, too. A module of yours is moved to the device, made channels-last
            and put into evaluation mode.
        weights: a safetensors file of other weights for a model given by name.
        device: where to run; frames may come from anywhere and images stay here.
        alpha_min: smallest weight of the current frame in the accumulation, in (0, 1], see
            :func:`mcdenoise.ops.accumulate`.
        anti_lag: give up the past where the light has changed, see :class:`mcdenoise.history.History`.
        precision: ``"bfloat16"`` runs the network's convolutions in bfloat16, which is about twice as fast on
            processors that have it; everything else stays in float32.
        plan: what to leave out of a scene that does not need it; ``Plan(keep_all=True)`` leaves nothing out.
        tile: run the network on tiles of at most so many pixels a side, a multiple of 32 from 64 on. The result is that
            of the whole image, up to the rounding of convolutions; the margins that tiles share cost time. By default
            they are as large as memory allows, and an image is in one piece where that takes no more than 2 GB (on a
            GPU: 0.4 of its memory) for the network's features, whatever is free: the same frames give the same images.
        max_memory: of the process on a CPU, or else of what torch holds on the device, in GB of 1e9 bytes. Tiles are
            so small that all keeps below it: what is there when the denoiser is made, the images of a frame and those
            of the past. Frames that you keep, beside the one that is denoised, are your own.

    Raises:
        InputError: the model is unknown, has no weights, the device is not there, the precision is unknown,
            ``alpha_min``, the tiles or the memory are no such number, or the model computes no parts.

    Example:
        >>> denoiser = Denoiser("cascaded")
        >>> frame = Frame(color=torch.rand(1, 3, 24, 32), depth=torch.ones(1, 1, 24, 32))
        >>> denoiser(frame).shape
        torch.Size([1, 3, 24, 32])
        >>> denoiser.report.missing
        ['albedo', 'normal']
    """

    def __init__(
        self,
        model: str | nn.Module = "cascaded",
        *,
        weights: Path | str | None = None,
        device: torch.device | str = "cpu",
        alpha_min: float = 0.1,
        anti_lag: bool = True,
        precision: Precision = "float32",
        plan: Plan | None = None,
        tile: int | None = None,
        max_memory: float | None = None,
    ) -> None:
        self.device = _device(device)
        if precision not in PRECISIONS:
            raise InputError(f"precision: expected one of {', '.join(PRECISIONS)}, found '{precision}'")
        self.precision = precision
        if not 0 < alpha_min <= 1:
            raise InputError(f"alpha_min: expected in (0, 1], found {alpha_min:g}")
        if isinstance(model, str):
            model = create_model(model, pretrained=weights is None, weights=weights)
        # Channels-last convolutions are about 1.5 times faster on a CPU.
        model.to(self.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.model = model.eval()
        self._takes_history = bool(getattr(model, "takes_history", False))
        self._takes_plan = bool(getattr(model, "takes_plan", False))
        self.plan = Plan() if plan is None else plan
        self.history = History(Accumulate(alpha_min), anti_lag=None if anti_lag else HistoryLag(math.inf))
        self.report = FrameReport()
        if tile is not None:
            check_side(tile)
            if max_memory is not None:
                raise InputError("tile, max_memory: expected one of them, found both; max_memory chooses the tiles")
        if not self._takes_plan and (tile, max_memory) != (None, None):
            raise InputError("tile, max_memory: expected a model that computes parts of an image, found one without")
        self.tile = tile
        self._memory = Memory(None if max_memory is None else max_memory * GB, self.device)
        self._tilings: dict[Frames, Tiling] = {}
        self.has_room_ahead = False

    def reset(
        self,
        buffers: Collection[str] | None = None,
        frames: int | None = None,
        size: tuple[int, int] | None = None,
    ) -> None:
        """Forget the past: the next frame is the first of a shot. A cut and a change of size do so by themselves.

        Args:
            buffers: names of the buffers that every frame of the shot will have, where that is known. Those that only
                serve a past (:meth:`mcdenoise.buffers.Frame.without_past`) are not counted where there will be none.
            frames: how many frames there will be, where that is known.
            size: their height and width, where that and the buffers are known. Then ``has_room_ahead`` says whether
                there is memory to read the next frame while one is denoised.

        Raises:
            InputError: frames of this size cannot be denoised within ``max_memory``; the message says with what.
        """
        self.history.reset()
        self.plan.reset(buffers, frames)
        # Of one frame there is nothing ahead.
        self.has_room_ahead = size is not None and frames != 1
        if buffers is not None and size is not None and self._takes_plan:
            streaming = self.plan.has_past(buffers)
            shot = Frames(size, frozenset(buffers) - (frozenset() if streaming else OF_THE_PAST), streaming)
            self._tiling(shot)
            self.has_room_ahead = self.has_room_ahead and self._memory.has_room_ahead(shot, self._needs())

    def __call__(self, frame: Frame) -> Tensor:
        """Denoise the next frame of the shot.

        Args:
            frame: a renderer's outputs, any float dtype; pixels of ``color`` that are NaN, infinite, negative or above
                1e16 are replaced and counted. Nothing of it is kept, so that the next frame may be written into the
                same buffers.

        Returns:
            ``(B, 3, H, W)`` float32 scene-linear radiance on the denoiser's device, to keep or to change; ``report``
            says what was done.

        Raises:
            InputError: a feature buffer holds NaN, an illegal infinity or a value far out of range; what the network
                makes of the frame is NaN or infinite; or there is too little memory, see :meth:`reset`. After this
                error, as after any other, the past is that of the frame before.
        """
        frame, past, steps, result = self._network(frame)
        final = result.final
        # Of a large frame each image is much: what is not needed any more goes first.
        del past, result
        return self._remodulated(frame, steps, final)[0]

    def images(self, frame: Frame) -> Images:
        """As calling the denoiser, with the images on the way to the result."""
        frame, past, steps, result = self._network(frame)
        return Images(frame.color.clone(), *self._remodulated(frame, steps, past.color, result.initial, result.final))

    def _network(self, frame: Frame) -> tuple[Frame, Accumulated, Steps, Denoised]:
        """The valid frame, its accumulated color, and what the network makes of it."""
        history, plan = self.history.snapshot(), self.plan.snapshot()
        try:
            return self._remembered(frame)
        except BaseException:
            # Given again, the frame must not count twice.
            self.history.restore(history)
            self.plan.restore(plan)
            raise

    @torch.inference_mode()
    def _remembered(self, frame: Frame) -> tuple[Frame, Accumulated, Steps, Denoised]:
        """As :meth:`_network`; where it fails, history and plan may have the frame already."""
        self.report = report = FrameReport()
        with self._timed("validate"):
            inspected = frame.to(self.device).to(torch.float32).inspect()
            inspected = inspected._replace(frame=inspected.frame.with_depth())
        frame, report.replaced_pixels, _ = inspected
        with self._timed("plan"):
            steps = self.plan.begin(inspected, self.history.is_still(frame))
        with self._timed("accumulate"):
            past = self.history.update(
                frame, demodulates=steps.demodulates, reprojects=steps.reprojects, keeps=steps.keeps
            )
        report.reset = past.reset
        _check_finite("accumulated", past.color)
        with self._timed("plan"):
            known, parts = self._shortcut(inspected, past)
            tiling = self._tiling(self._shot(frame))
            if tiling.side is not None:
                parts = [tile for part in parts for tile in part.split(tiling.side)]
            report.tiles = tiling.reason
        bfloat16 = torch.autocast(self.device.type, torch.bfloat16, enabled=self.precision == "bfloat16")
        with self._timed("network"), bfloat16:
            result = self._result(self._inputs(frame, past), past, steps, known, parts)
        _check_finite("initial", result.initial)
        _check_finite("denoised", result.final)
        with self._timed("plan"):
            self.plan.finish(*result, sum(part.pixels for part in parts) / (frame.size[0] * frame.size[1]))
        report.stages = self.plan.stages
        return frame, past, steps, result

    def _shot(self, frame: Frame) -> Frames:
        """What matters of a frame and those after it."""
        buffers = frozenset(name for name, _ in frame.items())
        return Frames(frame.size, buffers, self.plan.has_past(buffers), self.has_room_ahead, frame.color.shape[0])

    def _needs(self) -> Network:
        return Network(self.model.halo, self.model.bytes_per_pixel(bfloat16=self.precision == "bfloat16"))  # type: ignore

    def _tiling(self, frames: Frames) -> Tiling:
        """The parts of these frames on which the network runs."""
        if frames not in self._tilings:
            if not self._takes_plan:
                tiling = Tiling(None, "whole frames: the model computes no parts")
            elif self.tile is not None:
                tiling = Tiling(self.tile, f"{describe(frames.size, self.tile)}: as asked for")
            else:
                tiling = self._memory.choose(frames, self._needs())
            self._tilings[frames] = tiling
        return self._tilings[frames]

    def _shortcut(self, inspected: Inspected, past: Accumulated) -> tuple[Shortcut | None, list[Region]]:
        """What is known of the result, and the parts of the image to run the network on."""
        alpha_min = self.history.accumulate.alpha_min
        known = self.plan.known(inspected, past.color, past.current, past.length, past.reset, alpha_min)
        whole = [Region(0, 0, *inspected.frame.size)]
        if known is None or self.plan.keep_all:
            return known, whole
        if self._takes_plan:
            return known, self.model.parts(known.mask)  # type: ignore[operator]
        return known, [] if known.mask.all() else whole

    def _result(
        self,
        inputs: tuple[Tensor, Tensor, Tensor, Tensor],
        past: Accumulated,
        steps: Steps,
        known: Shortcut | None,
        parts: list[Region],
    ) -> Denoised:
        # A module of your own may do with the paper's four.
        history = {"current": past.current, "length": past.length} if self._takes_history else {}
        if self._takes_plan:
            given = None if known is None else Known(*known)
            return Denoised(*self.model(*inputs, **history, guides=steps.guides, known=given, parts=parts))
        if known is None:
            return Denoised(*self.model(*inputs, **history))
        result = Denoised(*self.model(*inputs, **history)) if parts else Denoised(known.initial, known.final)
        return Denoised(*(torch.where(known.mask, *pair) for pair in zip(known[1:], result, strict=True)))

    # Not in inference mode, whose tensors nobody may change or differentiate through.
    @torch.no_grad()
    def _remodulated(self, frame: Frame, steps: Steps, *images: Tensor) -> list[Tensor]:
        with self._timed("remodulate"):
            # A network that ends with a convolution hands out its precision.
            full = [image.float() for image in images]
            if frame.albedo is None or not steps.demodulates:
                # They may be what history and plan remember.
                return [image.clone() for image in full]
            return [by_rows(remodulate, image, frame.albedo) for image in full]

    def _inputs(self, frame: Frame, past: Accumulated) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The network's inputs; a feature that the frame lacks is constant, which guides nothing."""
        color = past.color
        features = {"albedo": frame.albedo, "normal": frame.normal, "depth": frame.depth}
        self.report.missing = [name for name, value in features.items() if value is None]
        albedo, normal, depth = features.values()
        return (
            color,
            torch.ones_like(color) if albedo is None else albedo,
            torch.zeros_like(color) if normal is None else normal,
            torch.ones_like(color[:, :1]) if depth is None else depth,
        )

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        start = self._clock()
        yield
        before = self.report.milliseconds.get(stage, 0.0)
        self.report.milliseconds[stage] = before + self._clock() - start

    def _clock(self) -> float:
        """Milliseconds, after the device has finished."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.perf_counter() * 1e3


def _check_finite(name: str, image: Tensor) -> None:
    """``InputError`` for an image with NaN or infinity."""
    # A sum is the fastest way to see either, and only what is far beyond all radiance overflows it.
    if image.sum().isfinite():
        return
    broken = int((~image.isfinite()).any(1).sum())
    if broken:
        raise InputError(
            f"{name} image: expected finite radiance, found {broken} NaN or infinite pixels; the frame is not kept: "
            "check the buffers for values far out of range and the network for weights that are"
        )


def _device(device: torch.device | str) -> torch.device:
    try:
        device = torch.device(device)
        torch.zeros((), device=device).item()
    except (RuntimeError, AssertionError, ImportError) as error:
        raise InputError(
            f"device '{device}': expected one that torch can use, found: {str(error).splitlines()[0]}"
        ) from error
    return device
