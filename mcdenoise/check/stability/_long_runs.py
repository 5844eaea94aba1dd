"""Runs over thousands of frames, which show whether an accumulated history drifts or overflows."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from mcdenoise.check.case import DTYPES
from mcdenoise.check.stability._check import LONG_RUNS, Check, bounded
from mcdenoise.ops import accumulate

# More than 2048, the longest history that float16 counts.
FRAMES, MOVING_FRAMES = 3_000, 1_000
ALPHA_MIN = 0.1
_SIZE = (4, 6)
_CONSTANT = 0.3
# Multiples of 1/32 pixel, which every dtype represents exactly.
_MOTION = (0.375, -0.21875)
_SHORT = torch.finfo(torch.float32).eps / 2


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
    # Without a minimum weight of the current frame the error of frame n is multiplied by (n - 1) / n in the next one.
    yield _drift("average", torch.float32, frames, (0.0, 0.0), 3 * _SHORT * (frames + 1), alpha_min=1 / (2 * frames))


def _drift(
    name: str,
    dtype: torch.dtype,
    frames: int,
    motion: tuple[float, float],
    allowed: float,
    alpha_min: float = ALPHA_MIN,
) -> Check:
    """``accumulate`` with a history in the dtype itself, against float64 on the same frames.

    Without motion a constant channel must not change, and the history length must be exact up to the first integer
    whose successor the dtype cannot represent, and stay there.
    """
    worst, message, largest = 0.0, "", torch.zeros(1, 3, 1, 1)
    both = (_histories(each, frames, motion, alpha_min) for each in (dtype, torch.float64))
    for number, ((history, length, color), (exact, *_)) in enumerate(zip(*both, strict=True), start=1):
        largest = torch.maximum(largest, color.amax((2, 3), keepdim=True))
        error = float(((history.double() - exact).abs() / largest).max())
        worst = max(worst, error if error == error else math.inf)
        if not any(motion) and not message:
            expected = min(number, round(2 / torch.finfo(dtype).eps))
            if not (history[:, 1] == torch.tensor(_CONSTANT, dtype=torch.bfloat16).to(dtype)).all():
                message = f"frame {number}: the constant channel has drifted"
            elif not (length == expected).all():
                message = f"frame {number}: expected a history length of {expected}, found {length.max().item():g}"
    return bounded(LONG_RUNS, name, dtype, "drift", worst, allowed, message=message)


def _histories(
    dtype: torch.dtype, frames: int, motion: tuple[float, float], alpha_min: float
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """The accumulated history after each frame, its length, and the frame."""
    generator = torch.Generator().manual_seed(0)
    color = _noise(generator)
    history, length = color.to(dtype), torch.ones(1, 1, *_SIZE, dtype=dtype)
    moved = torch.tensor(motion, dtype=dtype).reshape(1, 2, 1, 1).expand(1, 2, *_SIZE)
    yield history, length, color
    for _ in range(frames - 1):
        color = _noise(generator)
        history, length = accumulate(color.to(dtype), history, length, moved, alpha_min=alpha_min)
        yield history, length, color


def _noise(generator: torch.Generator) -> Tensor:
    """Noise, a constant, and noise with fireflies of 1e4 in three channels; every dtype represents them exactly."""
    color = torch.rand(1, 3, *_SIZE, generator=generator).clamp_min(1e-3)
    color[:, 1] = _CONSTANT
    hit = torch.rand(1, *_SIZE, generator=generator) < 1e-2
    color[:, 2] = torch.where(hit, 1e4, color[:, 2])
    return color.bfloat16().float()
