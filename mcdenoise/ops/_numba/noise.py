"""Differences of neighbouring pixels on a CPU: one pass over some rows and columns, where torch takes some fifty."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from mcdenoise.ops._constants import (
    BRIGHTEST,
    DARKEST_ALBEDO,
    EVEN_FEATURE,
    EVERY,
    FOURTH,
    LARGE_DIFFERENCE,
    LEAST_SUM,
    ROUNDED,
    UNEVEN,
)
from mcdenoise.ops._numba._runtime import compiled, copy_row, source
from mcdenoise.ops._operator import custom_op

# Pixels that are summed by themselves, for small rounding errors.
_PART = 32


def noise_sums(color: Tensor, albedo: Tensor | None, normal: Tensor | None, least: float) -> Any:
    """See :func:`mcdenoise.ops._steps.noise.noise_sums`."""
    given = [color] + [each for each in (albedo, normal) if each is not None]
    are_alike = all(each.dtype == color.dtype and each.shape == color.shape for each in given)
    if color.dtype not in (torch.float32, torch.float64) or not are_alike:
        return NotImplemented
    nothing = color[:, :0]
    return _noise_sums(color, nothing if albedo is None else albedo, nothing if normal is None else normal, least)


@custom_op(
    "mcdenoise::noise_sums",
    device_types="cpu",
    schema="(Tensor color, Tensor albedo, Tensor normal, float least) -> Tensor",
)
def _noise_sums(color: Tensor, albedo: Tensor, normal: Tensor, least: float) -> Tensor:
    sums = np.zeros((len(color), 2, 5))
    if color.numel():
        _sums(sums, tuple(color.shape[2:]), *(source(each) for each in (color, albedo, normal)), least)
    return torch.from_numpy(sums).to(color.dtype)


@_noise_sums.register_fake
def _(color: Tensor, *_: Any) -> Tensor:
    return color.new_empty(len(color), 2, 5)


@compiled
def _sums(sums: Any, size: Any, color: Any, albedo: Any, normal: Any, least: float) -> None:
    number = color[0].dtype.type
    zero, one, even, large = number(0), number(1), number(EVEN_FEATURE), number(LARGE_DIFFERENCE)
    for b in range(sums.shape[0]):
        for axis in range(2):
            length = size[1 - axis]
            # Two more pixels at both ends, and the steps between all of them.
            light, steps = np.empty(length + 4, color[0].dtype), np.empty(length + 3, color[0].dtype)
            row, tint = np.empty(length, color[0].dtype), np.empty(length, color[0].dtype)
            part = np.empty(5)
            for line in range(0, size[axis], EVERY):
                light[:], steps[:] = zero, zero
                for c in range(color[2]):
                    _read_line(row, color, b, c, axis, line)
                    tint[:] = one
                    if albedo[2]:
                        _read_line(tint, albedo, b, c, axis, line)
                        _find_steps(steps, tint)
                    for x in range(length):
                        light[2 + x] += max(row[x], zero) / max(tint[x], number(DARKEST_ALBEDO))
                for c in range(normal[2]):
                    _read_line(row, normal, b, c, axis, line)
                    _find_steps(steps, row)
                light /= number(color[2])
                light[:2], light[-2:] = light[2], light[-3]
                for start in range(0, length, _PART):
                    part[:] = 0
                    for x in range(start, min(start + _PART, length)):
                        inner, outer, middle = light[x + 1] + light[x + 3], light[x] + light[x + 4], light[x + 2]
                        mean = max(outer + inner + number(2) * middle, number(LEAST_SUM))
                        near = abs(outer - number(4) * inner + number(6) * middle) / (number(FOURTH) * mean)
                        wide = abs(outer - number(2) * middle) / mean
                        if near + wide > number(ROUNDED):
                            step = max(max(steps[x], steps[x + 1]), max(steps[x + 2], steps[x + 3]))
                            weight = max(one - step / even, number(UNEVEN))
                            part[0] += weight
                            part[1] += weight * wide
                            part[2] += weight if wide > number(least) else zero
                            part[3] += weight * (near / (near + large))
                            part[4] += weight * (wide / (wide + large))
                    sums[b, axis] += part


@compiled
def _read_line(row: Any, image: Any, b: int, c: int, axis: int, line: int) -> None:
    """A row (axis 0) or a column (axis 1) of a channel, with 0 for a NaN."""
    number = row.dtype.type
    zero, most = number(0), number(BRIGHTEST)
    strides = image[1]
    start = b * strides[0] + c * strides[1] + line * strides[2 + axis]
    copy_row(row, image, start, strides[3 - axis])
    for x in range(row.size):
        row[x] = min(max(row[x], -most), most) if row[x] == row[x] else zero


@compiled
def _find_steps(steps: Any, row: Any) -> None:
    for x in range(row.size - 1):
        steps[2 + x] = max(steps[2 + x], abs(row[x + 1] - row[x]))
