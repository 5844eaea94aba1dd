"""Averages of blocks of 2x2 pixels."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from mcdenoise.ops._numba._runtime import compiled, read_row, readable, share_rows, source
from mcdenoise.ops._window import accumulator_dtype


def downsample(image: Tensor) -> Tensor:
    """See :func:`mcdenoise.ops.downsample`."""
    batch, channels, height, width = image.shape
    shape = batch, channels, (height + 1) // 2, (width + 1) // 2
    result = torch.empty(shape, dtype=accumulator_dtype(image.dtype), device="cpu")
    if result.numel():
        arguments = (result.numpy(), source(readable(image, result.dtype)), height, width)
        share_rows(result, lambda *rows: _halve(*arguments, *rows), light=True)
    return result.to(image.dtype)


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
