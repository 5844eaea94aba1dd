"""Averages of blocks of 2x2 pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from mcdenoise.ops._numba._runtime import compiled, read_row, readable, share_rows, source
from mcdenoise.ops._operator import custom_op
from mcdenoise.ops._window import accumulator_dtype


@custom_op("mcdenoise::downsample", device_types="cpu", schema="(Tensor image) -> Tensor")
def downsample(image: Tensor) -> Tensor:
    """See :func:`mcdenoise.ops.downsample`."""
    result = _empty_half(image).to(accumulator_dtype(image.dtype))
    if result.numel():
        arguments = (result.numpy(), source(readable(image, result.dtype)), *image.shape[2:])
        share_rows(result, lambda *rows: _halve(*arguments, *rows), light=True)
    return result.to(image.dtype)


@downsample.register_fake
def _empty_half(image: Tensor) -> Tensor:
    batch, channels, height, width = image.shape
    return image.new_empty((batch, channels, (height + 1) // 2, (width + 1) // 2))


@compiled
def _halve(out: Any, image: Any, height: int, width: int, b: int, first: int, last: int) -> None:
    channels = out.shape[1]
    upper, lower = np.empty(width, out.dtype), np.empty(width, out.dtype)
    quarter, half = out.dtype.type(0.25), out.dtype.type(0.5)
    for y in range(first, last):
        for c in range(channels):
            read_row(upper, image, b, c, 2 * y, 0)
            read_row(lower, image, b, c, min(2 * y + 1, height - 1), 0)
            row = out[b, c, y]
            for x in range(width // 2):
                row[x] = (upper[2 * x] + upper[2 * x + 1] + lower[2 * x] + lower[2 * x + 1]) * quarter
            if width % 2:
                row[width // 2] = (upper[width - 1] + lower[width - 1]) * half
