"""The importance filter.

A window is a column of rows. Each row of each pixel is averaged once, and these means wait in a ring as long as a
window needs them, each with the largest importance in it and the sum of the weights beside that.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from mcdenoise.ops._numba._runtime import (
    add,
    add_product,
    compiled,
    exp,
    larger,
    multiply,
    read_row,
    readable,
    share_rows,
    source,
)
from mcdenoise.ops._window import accumulator_dtype


def importance_filter(image: Tensor, importance: Tensor, kernel_size: int) -> Tensor:
    """See :func:`mcdenoise.ops.importance_filter`."""
    dtype = torch.promote_types(accumulator_dtype(image.dtype), accumulator_dtype(importance.dtype))
    out = torch.empty(image.shape, dtype=dtype, device="cpu")
    if out.numel():
        arguments = (out.numpy(), source(readable(image, dtype)), source(readable(importance, dtype)), kernel_size)
        share_rows(image, lambda *rows: _average(*arguments, *rows))
    return out.to(image.dtype)


@compiled
def _average(out: Any, image: Any, importance: Any, kernel_size: int, b: int, first: int, last: int) -> None:
    """Rows ``first`` to ``last`` of the result."""
    _, channels, height, width = out.shape
    radius = kernel_size // 2
    maxima, totals = np.empty((kernel_size, width), out.dtype), np.empty((kernel_size, width), out.dtype)
    means = np.empty((kernel_size, channels, width), out.dtype)
    pixels, weights = np.empty((channels + 1, width), out.dtype), np.empty((kernel_size, width), out.dtype)
    maximum, total = np.empty(width, out.dtype), np.empty(width, out.dtype)
    for row in range(max(first - radius, 0), last + radius):
        if row < height:
            for c in range(channels):
                read_row(pixels[c], image, b, c, row, 0)
            read_row(pixels[channels], importance, b, 0, row, 0)
            at = row % kernel_size
            _average_row(maxima[at], totals[at], means[at], pixels, weights, radius)
        y = row - radius
        if y < first:
            continue
        start, end = max(y - radius, 0), min(y + radius + 1, height)
        maximum[:] = maxima[start % kernel_size]
        for r in range(start + 1, end):
            larger(maximum, maxima[r % kernel_size])
        total[:] = 0
        for r in range(start, end):
            at = r % kernel_size
            _weigh(weights[at], maxima[at], maximum)
            multiply(weights[at], totals[at])
            add(total, weights[at])
        out[b, :, y] = 0
        for r in range(start, end):
            at = r % kernel_size
            _divide(weights[at], total)
            for c in range(channels):
                add_product(out[b, c, y], weights[at], means[at, c])


@compiled
def _average_row(maximum: Any, total: Any, mean: Any, pixels: Any, weights: Any, radius: int) -> None:
    """Find the largest importance of a window in one row, the sum of the weights relative to it, and the mean."""
    channels, width = mean.shape
    importance = pixels[channels]
    maximum[:] = importance
    for side in range(1, min(radius, width - 1) + 1):
        larger(maximum[: width - side], importance[side:])
        larger(maximum[side:], importance[: width - side])
    total[:] = 0
    mean[:] = 0
    # Pixels outside the image add nothing.
    reach = min(radius, width - 1)
    for dx in range(-reach, reach + 1):
        start, end = max(-dx, 0), min(width - dx, width)
        weight = weights[dx + radius, start:end]
        _weigh(weight, importance[start + dx : end + dx], maximum[start:end])
        add(total[start:end], weight)
    for dx in range(-reach, reach + 1):
        start, end = max(-dx, 0), min(width - dx, width)
        weight = weights[dx + radius, start:end]
        _divide(weight, total[start:end])
        for c in range(channels):
            add_product(mean[c, start:end], weight, pixels[c, start + dx : end + dx])


@compiled
def _weigh(weights: Any, importance: Any, maximum: Any) -> None:
    for x in range(weights.size):
        weights[x] = exp(importance[x] - maximum[x])


@compiled
def _divide(weights: Any, total: Any) -> None:
    """Before they are used: a sum that is divided in the end would leave the range where a mean does not."""
    for x in range(weights.size):
        weights[x] /= total[x]
