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

from mcdenoise.buffers import Frame, Inspected
from mcdenoise.errors import InputError
from mcdenoise.history import Accumulated, History
from mcdenoise.models import Denoised, Known, Region, create_model
from mcdenoise.ops import Accumulate, HistoryLag, remodulate
from mcdenoise.plan import Plan, Shortcut, Stage, Steps

Precision = Literal["float32", "bfloat16"]
PRECISIONS: tuple[Precision, ...] = ("float32", "bfloat16")


@dataclass
class FrameReport:
    """What happened to one frame.

    Args:
        reset: why the history was thrown away, or ``""`` where it was used.
        replaced_pixels: pixels of the noisy color that were NaN, infinite or negative.
        missing: features that the network takes and the frame has not; it sees a constant instead.
        milliseconds: run time of each stage: validate, plan, accumulate, network, remodulate.
        stages: what was left out of them, and why.
    """

    reset: str = ""
    replaced_pixels: int = 0
    missing: list[str] = field(default_factory=list)
    milliseconds: dict[str, float] = field(default_factory=dict)
    stages: list[Stage] = field(default_factory=list)


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
            ``takes_plan``, ``guides``, ``known`` and ``parts``, see :class:`mcdenoise.models.Cascade`. A module of
            yours is moved to the device, made channels-last and put into evaluation mode.
        weights: a safetensors file of other weights for a model given by name.
        device: where to run; frames may come from anywhere and images stay here.
        alpha_min: smallest weight of the current frame in the accumulation, see :func:`mcdenoise.ops.accumulate`.
        anti_lag: give up the past where the light has changed, see :class:`mcdenoise.history.History`.
        precision: ``"bfloat16"`` runs the network's convolutions in bfloat16, which is about twice as fast on
            processors that have it; everything else stays in float32.
        plan: what to leave out of a scene that does not need it; ``Plan(keep_all=True)`` leaves nothing out.

    Raises:
        InputError: the model is unknown, has no weights, the device is not there, or the precision is unknown.

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
    ) -> None:
        self.device = _device(device)
        if precision not in PRECISIONS:
            raise InputError(f"precision: expected one of {', '.join(PRECISIONS)}, found '{precision}'")
        self.precision = precision
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

    def reset(self, buffers: Collection[str] | None = None, frames: int | None = None) -> None:
        """Forget the past: the next frame is the first of a shot. A cut and a change of size do so by themselves.

        Args:
            buffers: names of the buffers that every frame of the shot will have, where that is known.
            frames: how many frames there will be, where that is known.
        """
        self.history.reset()
        self.plan.reset(buffers, frames)

    def __call__(self, frame: Frame) -> Tensor:
        """Denoise the next frame of the shot.

        Args:
            frame: a renderer's outputs, any float dtype; NaN, infinite and negative pixels of ``color`` are replaced
                and counted.

        Returns:
            ``(B, 3, H, W)`` float32 scene-linear radiance on the denoiser's device; ``report`` says what was done.

        Raises:
            InputError: a feature buffer holds NaN, an illegal infinity or a value far out of range.
        """
        frame, _, steps, result = self._network(frame)
        return self._remodulated(frame, steps, result.final)[0]

    def images(self, frame: Frame) -> Images:
        """As calling the denoiser, with the images on the way to the result."""
        frame, past, steps, result = self._network(frame)
        return Images(frame.color, *self._remodulated(frame, steps, past.color, result.initial, result.final))

    @torch.inference_mode()
    def _network(self, frame: Frame) -> tuple[Frame, Accumulated, Steps, Denoised]:
        """The valid frame, its accumulated color, and what the network makes of it."""
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
        with self._timed("plan"):
            known, parts = self._shortcut(inspected, past)
        bfloat16 = torch.autocast(self.device.type, torch.bfloat16, enabled=self.precision == "bfloat16")
        with self._timed("network"), bfloat16:
            result = self._result(self._inputs(frame, past), past, steps, known, parts)
        with self._timed("plan"):
            self.plan.finish(*result, sum(part.pixels for part in parts) / (frame.size[0] * frame.size[1]))
        report.stages = self.plan.stages
        return frame, past, steps, result

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

    @torch.inference_mode()
    def _remodulated(self, frame: Frame, steps: Steps, *images: Tensor) -> list[Tensor]:
        with self._timed("remodulate"):
            # A network that ends with a convolution hands out its precision.
            full = [image.float() for image in images]
            if frame.albedo is None or not steps.demodulates:
                return full
            return [remodulate(image, frame.albedo) for image in full]

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


def _device(device: torch.device | str) -> torch.device:
    try:
        device = torch.device(device)
        torch.zeros((), device=device).item()
    except (RuntimeError, AssertionError, ImportError) as error:
        raise InputError(
            f"device '{device}': expected one that torch can use, found: {str(error).splitlines()[0]}"
        ) from error
    return device
