"""Runs over thousands of frames, which show whether an accumulated history drifts, overflows or ghosts."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from mcdenoise.check.stability._check import DTYPES, name_of
from mcdenoise.frame import Frame
from mcdenoise.models import Accumulated, FrameReport, Output, State
from mcdenoise.ops import accumulate
from mcdenoise.ops.lag import THRESHOLD

# More than 2048, the longest history that float16 counts.
FRAMES, MOVING_FRAMES = 3_000, 1_000
ALPHA_MIN = 0.1
_SIZE = (4, 6)
_WINDOW = 24  # pixels, so that a light that goes out is visible in several windows of the anti-lag rule
_CONSTANT = 0.3
# Multiples of 1/32 pixel, which every dtype represents exactly.
_MOTION = (0.375, -0.21875)
_GHOST = 0.01
_LIT = 60  # frames, after which the beginning of the exponential window is negligible


@dataclass(frozen=True)
class LongRun:
    """Result of accumulating a history over many frames.

    Args:
        name: name of the run.
        dtype: dtype of the frames.
        frames: numbers of frames after which the error was measured, ascending.
        errors: maximum error at these, relative to the maximum accumulated value of the channel.
        allowed: bound of the errors, or of ``ghost`` in runs that measure it.
        ghost: number of frames until less than 1 % of a light that went out is left; ``None`` in other runs.
        passed: whether the run passed.
        message: description of a failure; empty if the run passed.
    """

    name: str
    dtype: str
    frames: list[int] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)
    allowed: float = 0.0
    ghost: int | None = None
    passed: bool = True
    message: str = ""


def long_runs(
    dtypes: Sequence[torch.dtype] = DTYPES, frames: int = FRAMES, moving_frames: int = MOVING_FRAMES
) -> Iterator[LongRun]:
    """Perform every run in every dtype.

    Args:
        dtypes: dtypes of the frames.
        frames: number of frames with a static camera.
        moving_frames: number of frames with a moving camera.
    """
    yield from still(dtypes, frames)
    yield from moving(dtypes, moving_frames)
    for dtype in dtypes:
        yield cut(dtype)
    # Here the dtype affects only the frames, so one dtype suffices.
    yield average(max(dtypes, key=_unit), frames)
    for anti_lag in (False, True):
        yield light_off(anti_lag)
    yield light_on()


def still(dtypes: Sequence[torch.dtype] = DTYPES, frames: int = FRAMES) -> list[LongRun]:
    """``accumulate`` with a history in the dtype itself, against float64 on the same frames.

    A step multiplies the error by ``1 - alpha`` and adds one rounding error of the dtype and at most 8 of float32 of
    the stored value: ``e <= (u + 8 u32) max / alpha``. A constant channel must not change. The history length must be
    exact up to the first integer whose successor the dtype cannot represent, and stay there.
    """
    motion = torch.zeros(1, 2, *_SIZE)
    bounds = {dtype: (_unit(dtype) + 8 * _unit(torch.float32)) / ALPHA_MIN for dtype in dtypes}
    results = _accumulated("still", dtypes, frames, motion, bounds)
    return list(results)


def moving(dtypes: Sequence[torch.dtype] = DTYPES, frames: int = MOVING_FRAMES) -> list[LongRun]:
    """As :func:`still`, with a camera that moves by fractions of a pixel, so that every step interpolates.

    The bilinear weights add to the error of a step: ``q = p + motion`` is rounded as a number of up to the image's
    width ``W``, which makes 4 taps times ``2 u32 W`` of the maximum value.
    """
    motion = torch.tensor(_MOTION).reshape(1, 2, 1, 1).expand(1, 2, *_SIZE)
    weights = 8 * max(_SIZE) * _unit(torch.float32)
    bounds = {dtype: (_unit(dtype) + 8 * _unit(torch.float32) + weights) / ALPHA_MIN for dtype in dtypes}
    return list(_accumulated("moving", dtypes, frames, motion, bounds))


def _accumulated(
    name: str, dtypes: Sequence[torch.dtype], frames: int, motion: Tensor, bounds: dict[torch.dtype, float]
) -> Iterator[LongRun]:
    at = _times(frames)
    # The history of each dtype, and that of float64, whose length is never rounded.
    histories = {dtype: _noise(torch.Generator().manual_seed(0)).to(dtype) for dtype in (torch.float64, *dtypes)}
    lengths = {dtype: torch.ones(1, 1, *_SIZE, dtype=dtype) for dtype in histories}
    errors: dict[torch.dtype, list[float]] = {dtype: [] for dtype in dtypes}
    worst = dict.fromkeys(dtypes, 0.0)
    messages = dict.fromkeys(dtypes, "")
    generator, largest = torch.Generator().manual_seed(0), torch.zeros(1, 3, 1, 1)
    for number in range(1, frames + 1):
        color = _noise(generator) if number > 1 else _noise(torch.Generator().manual_seed(0))
        largest = torch.maximum(largest, color.amax((2, 3), keepdim=True))
        if number > 1:
            for dtype in histories:
                histories[dtype], lengths[dtype] = accumulate(
                    color.to(dtype), histories[dtype], lengths[dtype], motion.to(dtype), alpha_min=ALPHA_MIN
                )
        if number not in at:
            continue
        for dtype in dtypes:
            error = float(((histories[dtype].double() - histories[torch.float64]).abs() / largest).max())
            errors[dtype].append(error)
            worst[dtype] = max(worst[dtype], error if error == error else math.inf)
            messages[dtype] = messages[dtype] or _wrong(name, dtype, number, histories[dtype], lengths[dtype])
    for dtype in dtypes:
        message = messages[dtype]
        if worst[dtype] > bounds[dtype]:
            message = message or f"error {worst[dtype]:.3g}, expected at most {bounds[dtype]:.3g}"
        yield LongRun(name, name_of(dtype), at, errors[dtype], bounds[dtype], None, not message, message)


def _wrong(name: str, dtype: torch.dtype, number: int, history: Tensor, length: Tensor) -> str:
    """The error in a history after some frames, or an empty string."""
    if not torch.isfinite(history).all() or not torch.isfinite(length).all():
        return f"frame {number}: a value or a length is not finite"
    if name != "still":
        return ""
    if not (history[:, 1] == torch.tensor(_CONSTANT, dtype=torch.bfloat16).to(dtype)).all():
        return f"frame {number}: the constant channel has drifted"
    expected = min(number, round(2 / torch.finfo(dtype).eps))
    if not (length == expected).all():
        return f"frame {number}: expected a history length of {expected}, found {length.max().item():g}"
    return ""


def average(dtype: torch.dtype, frames: int = FRAMES) -> LongRun:
    """The mean of all frames (no minimum weight of the current one) in :class:`mcdenoise.models.Accumulated`.

    It is stored in float32 for frames of any dtype. The error of frame ``n`` is multiplied by ``(n - 1) / n`` in the
    next one, so that 6 rounding errors per frame sum up to at most ``6 u32 (n + 1) / 2``.
    """
    at = _times(frames)
    shot = _Shot(alpha_min=1 / (2 * frames), lag_threshold=math.inf)
    generator = torch.Generator().manual_seed(0)
    total, errors, message = torch.zeros(1, 3, *_SIZE, dtype=torch.float64), list[float](), ""
    motion = torch.zeros(1, 2, *_SIZE, dtype=dtype)
    for number in range(1, frames + 1):
        color = _noise(generator, fireflies=False).to(dtype)
        mean, length = shot.accumulate(Frame(color=color, motion=motion))
        total += color.double()
        if number in at:
            errors.append(float((mean.double() - total / number).abs().max()))
            if not (length == number).all():
                message = message or f"frame {number}: found a history length of {length.max().item():g}"
    allowed = 3 * _unit(torch.float32) * (frames + 1)
    if not max(errors) <= allowed:
        message = message or f"error {max(errors):.3g}, expected at most {allowed:.3g}"
    return LongRun("average", name_of(dtype), at, errors, allowed, None, not message, message)


def cut(dtype: torch.dtype) -> LongRun:
    """A scene cut after a long history: the image of the first frame after it is exactly that frame."""
    shot, generator = _Shot(), torch.Generator().manual_seed(0)
    walls = torch.eye(3, dtype=dtype).reshape(3, 1, 3, 1, 1).expand(3, 1, 3, *_SIZE)
    motion = torch.zeros(1, 2, *_SIZE, dtype=dtype)
    for _ in range(_LIT):
        shot.accumulate(Frame(color=100 * _noise(generator).to(dtype), normal=walls[0], motion=motion))
    color = _noise(generator, fireflies=False).to(dtype)
    found, length = shot.accumulate(Frame(color=color, normal=walls[1], motion=motion))
    gone = shot.reset == "cut" and torch.equal(found, color.to(found.dtype)) and bool((length == 1).all())
    message = "" if gone else "part of the scene before the cut is left"
    return LongRun("cut", name_of(dtype), passed=gone, message=message)


def light_off(anti_lag: bool) -> LongRun:
    """A light that goes out, at one sample per pixel: the number of frames until less than 1 % of it is left.

    Without the anti-lag rule it is the first ``k`` with ``(1 - alpha)^k < 0.01``: 44 frames for 0.1. With the rule it
    is one frame, because a black frame has no noise that could hide the change.
    """
    means = _light([1.0] * _LIT + [0.0] * _LIT, anti_lag)[_LIT:]
    ghost = next((number for number, mean in enumerate(means, start=1) if mean < _GHOST), len(means))
    allowed = 1 if anti_lag else math.ceil(math.log(_GHOST) / math.log(1 - ALPHA_MIN))
    message = "" if ghost <= allowed else f"the ghost lasts {ghost} frames, expected at most {allowed}"
    name = f"light off, {'with' if anti_lag else 'without'} anti-lag"
    return LongRun(name, "float32", allowed=allowed, ghost=ghost, passed=not message, message=message)


def light_on() -> LongRun:
    """Constant light must not be mistaken for lag: with the rule, the noise rises by at most 1 %.

    With normal noise 5 % of the windows differ by 2 standard errors, and fewer than one in ten thousand by 4, from
    which on the whole history is discarded: on average less than 1 % of it, whose variance rises at most 4 times.
    """
    runs = {anti_lag: _light([1.0] * 2 * _LIT, anti_lag, deviation=True)[_LIT:] for anti_lag in (False, True)}
    rise = sum(runs[True]) / sum(runs[False]) - 1
    message = "" if rise <= _GHOST else f"noise rises by {100 * rise:.2g} %, expected at most 1 %"
    return LongRun("steady light, with anti-lag", "float32", [_LIT], [rise], _GHOST, None, not message, message)


def _light(levels: Sequence[float], anti_lag: bool, deviation: bool = False) -> list[float]:
    """Mean of the history after each frame, for a surface lit at these levels, or its deviation from the level."""
    shot = _Shot(alpha_min=ALPHA_MIN, lag_threshold=THRESHOLD if anti_lag else math.inf)
    generator, shape = torch.Generator().manual_seed(0), (1, 3, _WINDOW, _WINDOW)
    found: list[float] = []
    for level in levels:
        # The exponential distribution has a long tail, like path tracing.
        noise = -torch.log(torch.rand(shape, generator=generator).clamp_min(1e-6))
        color, _ = shot.accumulate(Frame(color=level * noise, motion=torch.zeros(1, 2, _WINDOW, _WINDOW)))
        found.append(float((color - level).square().mean().sqrt() if deviation else color.mean()))
    return found


class _Shot:
    """Accumulates the frames of a shot with :class:`mcdenoise.models.Accumulated` around an identity."""

    def __init__(self, **settings: float) -> None:
        self._model = Accumulated(_with_length, **settings)  # type: ignore[arg-type]
        self._state: State = None
        self.reset = ""

    @torch.no_grad()
    def accumulate(self, frame: Frame) -> tuple[Tensor, Tensor]:
        """The accumulated color of the next frame, and the length of its history."""
        output, self._state = self._model(frame, self._state)
        report = FrameReport()
        report.add(output.notes)
        self.reset = report.reset
        return output.image, output.stages["length"]


def _with_length(color: Tensor, length: Tensor) -> Output:
    return Output(color, {"length": length})


def _noise(generator: torch.Generator, fireflies: bool = True) -> Tensor:
    """Noise, a constant, and noise with fireflies of 1e4 in three channels; every dtype represents them exactly."""
    color = torch.rand(1, 3, *_SIZE, generator=generator).clamp_min(1e-3)
    color[:, 1] = _CONSTANT
    if fireflies:
        hit = torch.rand(1, *_SIZE, generator=generator) < 1e-2
        color[:, 2] = torch.where(hit, 1e4, color[:, 2])
    return color.bfloat16().float()


def _times(frames: int) -> list[int]:
    """The frame numbers 1, 3, 10, 30, 100, ... and the last."""
    numbers = (digit * 10**power for power in range(9) for digit in (1, 3))
    return sorted({number for number in numbers if number < frames} | {frames})


def _unit(dtype: torch.dtype) -> float:
    return torch.finfo(dtype).eps / 2
