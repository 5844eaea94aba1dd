"""The steps between the convolutions of networks, on a CPU.

They go row by row, each by a few vectorised loops: no argument is copied as a whole, whatever its layout and
precision, and of intermediate results only a few rows are stored.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from mcdenoise.ops._constants import SHORTEST
from mcdenoise.ops._numba._runtime import (
    compiled,
    exp,
    expm1,
    log1p,
    read_row,
    readable,
    rounded,
    share_rows,
    source,
)
from mcdenoise.ops._window import accumulator_dtype, computing_dtype

# Pixels whose channels are gathered at a time: they stay in the second-level cache.
CHUNK = 1024


def buffers_input(
    image: Tensor,
    albedo: Tensor,
    normal: Tensor,
    depth: Tensor,
    current: Tensor,
    length: Tensor | None,
    exposure: Tensor,
    scale: tuple[Tensor, Tensor],
    logarithms: bool,
) -> Any:
    """See :func:`mcdenoise.ops._steps.network.buffers_input`."""
    dtype = computing_dtype(image)
    if torch.float16 in (image.dtype, albedo.dtype, dtype):
        return NotImplemented
    batch, _, height, width = image.shape
    result = torch.empty((batch, 14, height, width), dtype=dtype, memory_format=torch.channels_last, device="cpu")
    if result.numel():
        sums = torch.promote_types(dtype, torch.float32)
        images = tuple(source(readable(buffer, sums)) for buffer in (image, albedo, normal, depth, current))
        lengths = source(readable(depth[:, :0] if length is None else length, sums))
        factors = torch.cat([each.to(sums).expand(batch, 1, 1, 1) for each in (exposure, *scale)], 1).flatten(1)
        arguments = (source(result), images, lengths, factors.numpy(), logarithms, width)
        share_rows(image, lambda *rows: _stack_buffers(*arguments, *rows))
    return result


@compiled
def _stack_buffers(
    out: Any,
    images: Any,
    length: Any,
    factors: Any,
    logarithms: bool,
    width: int,
    b: int,
    first: int,
    last: int,
) -> None:
    image, albedo, normal, depth, current = images
    memory, strides, channels = out
    exposure, near, typical = factors[b]
    half, one = factors.dtype.type(0.5), factors.dtype.type(1)
    rows, bits = np.empty((channels, CHUNK), factors.dtype), np.empty((channels, CHUNK), memory.dtype)
    for y in range(first, last):
        for x0 in range(0, width, CHUNK):
            n = min(CHUNK, width - x0)
            for c in range(3):
                row = rows[c, :n]
                read_row(row, image, b, c, y, x0)
                if logarithms:
                    _to_logarithms(row, one)
                read_row(rows[3 + c, :n], albedo, b, c, y, x0)
                row = rows[6 + c, :n]
                read_row(row, normal, b, c, y, x0)
                for x in range(n):
                    row[x] = row[x] * half + half
                row = rows[10 + c, :n]
                read_row(row, current, b, c, y, x0)
                _to_logarithms(row, exposure)
            row = rows[9, :n]
            read_row(row, depth, b, 0, y, x0)
            _normalize(row, near, typical)
            row = rows[13, :n]
            if length[2]:
                read_row(row, length, b, 0, y, x0)
                for x in range(n):
                    row[x] = one / row[x]
            else:
                row[:] = one
            for c in range(channels):
                round_row(bits[c, :n], rows[c])
            start = b * strides[0] + y * strides[2] + x0 * strides[3]
            interleave(memory[start : start + n * channels], bits)


@compiled
def _normalize(depths: Any, near: Any, typical: Any) -> None:
    shortest, infinity, one = depths.dtype.type(SHORTEST), depths.dtype.type(np.inf), depths.dtype.type(1)
    longest = one / shortest
    for x in range(depths.size):
        depth = depths[x]
        in_units = min(max(depth / near, shortest), longest)
        depths[x] = in_units / (in_units + typical) if depth < infinity else one


@compiled
def _to_logarithms(values: Any, factor: Any) -> None:
    for x in range(values.size):
        values[x] = log1p(values[x] * factor)


@compiled
def round_row(bits: Any, values: Any) -> None:
    for x in range(bits.size):
        bits[x] = rounded(values[x], bits)


@compiled
def interleave(pixels: Any, rows: Any) -> None:
    """Rows of channels to pixels with their channels side by side."""
    channels = rows.shape[0]
    n = pixels.size // channels
    for c in range(channels):
        row = rows[c]
        for x in range(n):
            pixels[x * channels + c] = row[x]


def gated_fusion(
    fine: Tensor,
    coarse: Tensor,
    weight: Tensor,
    bias: Tensor,
    residual: Tensor | None,
    maximum: Tensor | None,
    logarithms: bool,
) -> Tensor:
    """See :func:`mcdenoise.ops._steps.network.gated_fusion`."""
    dtype = accumulator_dtype(fine.dtype)
    result = torch.empty(fine.shape, dtype=dtype, device="cpu")
    if result.numel():
        residual = fine[:, :0] if residual is None else residual
        limits = result.new_empty(0) if maximum is None else maximum.to(dtype).expand(len(fine), 1, 1, 1).flatten()
        images = (source(readable(image, dtype)) for image in (fine, residual, coarse))
        numbers = (each.detach().to(dtype).contiguous().numpy() for each in (weight, bias, limits))
        arguments = (result.numpy(), *images, *numbers, logarithms)
        share_rows(fine, lambda *rows: _fuse(*arguments, *rows))
    return result


@compiled
def _fuse(
    out: Any,
    fine: Any,
    residual: Any,
    coarse: Any,
    weight: Any,
    bias: Any,
    maximum: Any,
    logarithms: bool,
    b: int,
    first: int,
    last: int,
) -> None:
    """Rows ``first`` to ``last`` of the result, two at a time: they share the blocks whose mean is exchanged."""
    _, channels, height, width = out.shape
    dtype = out.dtype
    # Four rows of both images, the coarse one upsampled, with the zeros of the convolution around them.
    ring = np.zeros((4, 2 * channels, width + 2), dtype)
    alpha, change = np.empty(width, dtype), np.empty((channels, width), dtype)
    half = np.empty((width + 1) // 2, dtype)
    above, below = np.empty(width, dtype), np.empty(width, dtype)
    begin = first // 2 * 2
    for y in range(begin, last, 2):
        for row in range(y - 1 if y == begin else y + 1, y + 3):
            _fetch_both(ring[row % 4], fine, logarithms, residual, coarse, half, change[0], b, row, height)
        for c in range(channels):
            upper = ring[y % 4, c, 1 : width + 1]
            lower = ring[(y + 1 if y + 1 < height else y) % 4, c, 1 : width + 1]
            low = ring[y % 4, channels + c, 1 : width + 1]
            if logarithms:
                # The logarithms are those of means of radiance, which is read once more.
                read_row(above, fine, b, c, y, 0)
                read_row(below, fine, b, c, min(y + 1, height - 1), 0)
                _mean_of_blocks(half, above, below)
                _to_logarithms(half, dtype.type(1))
                _double(change[c], half)
            else:
                _mean_of_blocks(half, upper, lower)
                _double(change[c], half)
            for x in range(width):
                change[c, x] = low[x] - change[c, x]
        for row in range(max(y, first), min(y + 2, last)):
            alpha[:] = bias[0]
            for dy in range(3):
                rows = ring[(row + dy - 1) % 4]
                for c in range(2 * channels):
                    _correlate(alpha, rows[c], weight[0, c, dy])
            _sigmoid(alpha)
            for c in range(channels):
                values = out[b, c, row]
                _add_fraction(values, ring[row % 4, c, 1 : width + 1], alpha, change[c])
                if maximum.size:
                    _to_radiance(values, maximum[b])


@compiled
def _fetch_both(
    rows: Any,
    fine: Any,
    logarithms: bool,
    residual: Any,
    coarse: Any,
    half: Any,
    buffer: Any,
    b: int,
    y: int,
    height: int,
) -> None:
    """Row ``y`` of the fine and of the upsampled coarse image; zeros beyond the image."""
    channels, width = fine[2], buffer.size
    if y < 0 or y >= height:
        rows[:] = 0
        return
    for c in range(channels):
        row = rows[c, 1 : width + 1]
        read_row(row, fine, b, c, y, 0)
        if logarithms:
            _to_logarithms(row, row.dtype.type(1))
        if residual[2]:
            read_row(buffer, residual, b, c, y, 0)
            for x in range(width):
                row[x] += buffer[x]
        read_row(half, coarse, b, c, y // 2, 0)
        _double(rows[channels + c, 1 : width + 1], half)


@compiled
def _double(row: Any, half: Any) -> None:
    """Each number twice, and the last of an odd row once."""
    for x in range(row.size // 2):
        row[2 * x] = half[x]
        row[2 * x + 1] = half[x]
    if row.size % 2:
        row[row.size - 1] = half[half.size - 1]


@compiled
def _mean_of_blocks(mean: Any, upper: Any, lower: Any) -> None:
    """Means of 2x2 pixels of two rows; of two pixels in the last column where the width is odd."""
    quarter, half, width = mean.dtype.type(0.25), mean.dtype.type(0.5), upper.size
    for x in range(width // 2):
        mean[x] = (upper[2 * x] + upper[2 * x + 1] + lower[2 * x] + lower[2 * x + 1]) * quarter
    if width % 2:
        mean[width // 2] = (upper[width - 1] + lower[width - 1]) * half


@compiled
def _correlate(total: Any, row: Any, weights: Any) -> None:
    left, centre, right = weights
    for x in range(total.size):
        total[x] += left * row[x] + centre * row[x + 1] + right * row[x + 2]


@compiled
def _sigmoid(values: Any) -> None:
    one = values.dtype.type(1)
    for x in range(values.size):
        values[x] = one / (one + exp(-values[x]))


@compiled
def _add_fraction(out: Any, values: Any, fraction: Any, change: Any) -> None:
    for x in range(out.size):
        out[x] = values[x] + fraction[x] * change[x]


@compiled
def _to_radiance(values: Any, maximum: Any) -> None:
    zero = values.dtype.type(0)
    for x in range(values.size):
        # A comparison with a NaN is false, and the NaN stays.
        value = zero if values[x] < zero else values[x]
        values[x] = expm1(maximum if value > maximum else value)
