"""Runs over thousands of frames, which show whether an accumulated history drifts, overflows or ghosts."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial

import torch
from torch import Tensor

from mcdenoise.check.stability._check import DTYPES, LONG_RUNS, Check, bounded, held
from mcdenoise.frame import Frame
from mcdenoise.models import Accumulated, Output, State
from mcdenoise.models._report import FrameReport
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
_SHORT = torch.finfo(torch.float32).eps / 2
_run = partial(bounded, LONG_RUNS)


def long_runs(
    dtypes: Sequence[torch.dtype] = DTYPES, frames: int = FRAMES, moving_frames: int = MOVING_FRAMES
) -> Iterator[Check]:
    """Perform every run in every dtype.

    A step of ``accumulate`` multiplies the error by ``1 - alpha`` and adds one rounding error of the dtype and at most
    8 of float32 of the stored value: ``e <= (u + 8 u32) max / alpha``. With a camera that moves by fractions of a pixel
    ``q = p + motion`` is rounded as a number of up to the image's width ``W``, which makes 4 taps times ``2 u32 W`` of
    the maximum value.

    Args:
        dtypes: dtypes of the frames.
        frames: number of frames with a static camera.
        moving_frames: number of frames with a moving camera.
    """
    for dtype in dtypes:
        step = torch.finfo(dtype).eps / 2 + 8 * _SHORT
        yield _drift("still", dtype, frames, (0.0, 0.0), step / ALPHA_MIN)
        yield _drift("moving", dtype, moving_frames, _MOTION, (step + 8 * max(_SIZE) * _SHORT) / ALPHA_MIN)
        yield cut(dtype)
    # Here the dtype affects only the frames, so one dtype suffices.
    yield average(max(dtypes, key=lambda dtype: torch.finfo(dtype).eps), frames)
    for anti_lag in (False, True):
        yield light_off(anti_lag)
    yield light_on()


def _drift(name: str, dtype: torch.dtype, frames: int, motion: tuple[float, float], allowed: float) -> Check:
    """``accumulate`` with a history in the dtype itself, against float64 on the same frames.

    Without motion a constant channel must not change, and the history length must be exact up to the first integer
    whose successor the dtype cannot represent, and stay there.
    """
    worst, message, largest = 0.0, "", torch.zeros(1, 3, 1, 1)
    both = zip(_histories(dtype, frames, motion), _histories(torch.float64, frames, motion), strict=True)
    for number, ((history, length, color), (exact, *_)) in enumerate(both, start=1):
        largest = torch.maximum(largest, color.amax((2, 3), keepdim=True))
        error = float(((history.double() - exact).abs() / largest).max())
        worst = max(worst, error if error == error else math.inf)
        if name == "still" and not message:
            expected = min(number, round(2 / torch.finfo(dtype).eps))
            if not (history[:, 1] == torch.tensor(_CONSTANT, dtype=torch.bfloat16).to(dtype)).all():
                message = f"frame {number}: the constant channel has drifted"
            elif not (length == expected).all():
                message = f"frame {number}: expected a history length of {expected}, found {length.max().item():g}"
    return held(LONG_RUNS, name, dtype, "drift", message) if message else _run(name, dtype, "drift", worst, allowed)


def _histories(dtype: torch.dtype, frames: int, motion: tuple[float, float]) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """The accumulated history after each frame, its length, and the frame."""
    generator = torch.Generator().manual_seed(0)
    color = _noise(generator)
    history, length = color.to(dtype), torch.ones(1, 1, *_SIZE, dtype=dtype)
    moved = torch.tensor(motion, dtype=dtype).reshape(1, 2, 1, 1).expand(1, 2, *_SIZE)
    yield history, length, color
    for _ in range(frames - 1):
        color = _noise(generator)
        history, length = accumulate(color.to(dtype), history, length, moved, alpha_min=ALPHA_MIN)
        yield history, length, color


def average(dtype: torch.dtype, frames: int = FRAMES) -> Check:
    """The mean of all frames (no minimum weight of the current one) in :class:`mcdenoise.models.Accumulated`.

    It is stored in float32 for frames of any dtype. The error of frame ``n`` is multiplied by ``(n - 1) / n`` in the
    next one, so that 6 rounding errors per frame sum up to at most ``6 u32 (n + 1) / 2``.
    """
    shot = _Shot(alpha_min=1 / (2 * frames), lag_threshold=math.inf)
    generator, motion = torch.Generator().manual_seed(0), torch.zeros(1, 2, *_SIZE, dtype=dtype)
    total, worst = torch.zeros(1, 3, *_SIZE, dtype=torch.float64), 0.0
    for number in range(1, frames + 1):
        color = _noise(generator, fireflies=False).to(dtype)
        mean, length = shot.accumulate(Frame(color=color, motion=motion))
        total += color.double()
        worst = max(worst, float((mean.double() - total / number).abs().max()))
        if not (length == number).all():
            message = f"frame {number}: found a history length of {length.max().item():g}"
            return held(LONG_RUNS, "average", dtype, "drift", message)
    return _run("average", dtype, "drift", worst, 3 * _SHORT * (frames + 1))


def cut(dtype: torch.dtype) -> Check:
    """A scene cut after a long history: the image of the first frame after it is exactly that frame."""
    shot, generator = _Shot(), torch.Generator().manual_seed(0)
    walls = torch.eye(3, dtype=dtype).reshape(3, 1, 3, 1, 1).expand(3, 1, 3, *_SIZE)
    motion = torch.zeros(1, 2, *_SIZE, dtype=dtype)
    for _ in range(_LIT):
        shot.accumulate(Frame(color=100 * _noise(generator).to(dtype), normal=walls[0], motion=motion))
    color = _noise(generator, fireflies=False).to(dtype)
    found, length = shot.accumulate(Frame(color=color, normal=walls[1], motion=motion))
    gone = shot.reset == "cut" and torch.equal(found, color.to(found.dtype)) and bool((length == 1).all())
    return held(LONG_RUNS, "cut", dtype, "cut", "" if gone else "part of the scene before the cut is left")


def light_off(anti_lag: bool) -> Check:
    """A light that goes out, at one sample per pixel: the number of frames until less than 1 % of it is left.

    Without the anti-lag rule it is the first ``k`` with ``(1 - alpha)^k < 0.01``: 44 frames for 0.1. With the rule it
    is one frame, because a black frame has no noise that could hide the change.
    """
    means = _light([1.0] * _LIT + [0.0] * _LIT, anti_lag)[_LIT:]
    ghost = next((number for number, mean in enumerate(means, start=1) if mean < _GHOST), len(means))
    allowed = 1 if anti_lag else math.ceil(math.log(_GHOST) / math.log(1 - ALPHA_MIN))
    return _run(f"light off, {'with' if anti_lag else 'without'} anti-lag", torch.float32, "ghost", ghost, allowed)


def light_on() -> Check:
    """Constant light must not be mistaken for lag: with the rule, the noise rises by at most 1 %.

    With normal noise 5 % of the windows differ by 2 standard errors, and fewer than one in ten thousand by 4, from
    which on the whole history is discarded: on average less than 1 % of it, whose variance rises at most 4 times.
    """
    runs = {anti_lag: _light([1.0] * 2 * _LIT, anti_lag, deviation=True)[_LIT:] for anti_lag in (False, True)}
    rise = sum(runs[True]) / sum(runs[False]) - 1
    return _run("steady light, with anti-lag", torch.float32, "noise", max(rise, 0.0), _GHOST)


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
