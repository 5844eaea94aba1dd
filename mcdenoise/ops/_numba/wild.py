"""The steps before and behind the network of ``wild`` on a CPU: one pass each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mcdenoise.ops._numba._runtime import compiled, exp, read_row, rounded, share_rows, source
from mcdenoise.ops._numba.transfer import compress_values, expand_values
from mcdenoise.ops._window import computing_dtype

# Pixels whose channels are gathered at a time: they stay in the second-level cache.
_CHUNK = 1024


def wild_input(
    color: Tensor,
    alone: Tensor,
    history: Tensor,
    albedo: Tensor | None,
    normal: Tensor | None,
    part: Tensor,
    exposure: Tensor,
    multiple: int,
) -> Any:
    """See :func:`mcdenoise.ops._steps.wild.wild_input`."""
    dtype = computing_dtype(color)
    # A single number that is read for every pixel.
    albedo = color.new_ones(1, 1, 1, 1).expand_as(color) if albedo is None else albedo
    normal = color.new_zeros(1, 1, 1, 1).expand_as(color) if normal is None else normal
    buffers = (color, alone, history, albedo, normal, part, exposure.expand(len(color), 1, 1, 1))
    if dtype == torch.float16 or not _are_alike(*buffers):
        return NotImplemented
    batch, _, height, width = color.shape
    rows, columns = (-(-side // multiple) * multiple for side in (height, width))
    seen = torch.empty((batch, 16, rows, columns), dtype=dtype, memory_format=torch.channels_last, device="cpu")
    seen[..., height:, :], seen[..., width:] = 0, 0
    images = torch.empty((batch, 9, height, width), dtype=color.dtype, device="cpu")
    if images.numel():
        arguments = (source(seen), images.numpy(), *map(source, buffers))
        share_rows(color, lambda *rows: _input_rows(*arguments, *rows))
    return seen, images


def wild_choice(predicted: Tensor, images: Tensor, part: Tensor, exposure: Tensor, offsets: Sequence[float]) -> Any:
    """See :func:`mcdenoise.ops._steps.wild.wild_choice`."""
    read = (predicted, images, part, exposure.expand(len(images), 1, 1, 1))
    if not _are_alike(*read):
        return NotImplemented
    result = torch.empty((len(images), 3, *images.shape[2:]), dtype=images.dtype, device="cpu")
    if result.numel():
        arguments = (result.numpy(), *map(source, read), np.array(offsets, result.numpy().dtype))
        share_rows(images, lambda *rows: _choice_rows(*arguments, *rows))
    return result


def _are_alike(*images: Tensor) -> bool:
    """Whether all have one dtype that is supported, and all but the last, the exposure, the same batch and size."""
    first, dtype = images[0], images[0].dtype
    same_size = all((len(image), *image.shape[2:]) == (len(first), *first.shape[2:]) for image in images[:-1])
    return dtype in (torch.float32, torch.float64) and all(image.dtype == dtype for image in images) and same_size


@compiled
def _input_rows(
    out: Any,
    images: Any,
    color: Any,
    alone: Any,
    history: Any,
    albedo: Any,
    normal: Any,
    part: Any,
    exposure: Any,
    b: int,
    first: int,
    last: int,
) -> None:
    memory, strides, channels = out
    number = images.dtype.type
    zero, one, half = number(0), number(1), number(0.5)
    width = images.shape[3]
    factor = exposure[0][b * exposure[1][0]]
    bits = np.empty((channels, _CHUNK), memory.dtype)
    row = np.empty(_CHUNK, images.dtype)
    for y in range(first, last):
        for x0 in range(0, width, _CHUNK):
            n = min(_CHUNK, width - x0)
            values, rows = row[:n], bits[:, :n]
            for c in range(3):
                _scaled(images[b, c, y, x0 : x0 + n], color, b, c, y, x0, factor)
                _scaled(images[b, 3 + c, y, x0 : x0 + n], alone, b, c, y, x0, factor)
                _scaled(images[b, 6 + c, y, x0 : x0 + n], history, b, c, y, x0, factor)
                _round_row(rows[c], images[b, c, y, x0 : x0 + n])
                _round_row(rows[9 + c], images[b, 3 + c, y, x0 : x0 + n])
                _round_row(rows[12 + c], images[b, 6 + c, y, x0 : x0 + n])
                read_row(values, albedo, b, c, y, x0)
                for x in range(n):
                    values[x] = min(max(values[x], zero), one)
                _round_row(rows[3 + c], values)
                read_row(values, normal, b, c, y, x0)
                for x in range(n):
                    values[x] = min(max(values[x], -one), one) * half + half
                _round_row(rows[6 + c], values)
            read_row(values, part, b, 0, y, x0)
            _round_row(rows[15], values)
            start = b * strides[0] + y * strides[2] + x0 * strides[3]
            _interleave(memory[start : start + n * channels], rows)


@compiled
def _round_row(bits: Any, values: Any) -> None:
    for x in range(bits.size):
        bits[x] = rounded(values[x], bits)


@compiled
def _interleave(pixels: Any, rows: Any) -> None:
    """Rows of channels to pixels with their channels side by side."""
    channels = rows.shape[0]
    n = pixels.size // channels
    for c in range(channels):
        row = rows[c]
        for x in range(n):
            pixels[x * channels + c] = row[x]


@compiled
def _scaled(row: Any, image: Any, b: int, c: int, y: int, x0: int, factor: Any) -> None:
    read_row(row, image, b, c, y, x0)
    for x in range(row.size):
        row[x] *= factor
    compress_values(row)


@compiled
def _choice_rows(
    out: Any, predicted: Any, images: Any, part: Any, exposure: Any, offsets: Any, b: int, first: int, last: int
) -> None:
    number = out.dtype.type
    zero = number(0)
    width = out.shape[3]
    factor = exposure[0][b * exposure[1][0]]
    weights, choices = np.empty((5, width), out.dtype), np.empty((4, width), out.dtype)
    for y in range(first, last):
        for k in range(4):
            read_row(weights[k], predicted, b, 3 + k, y, 0)
        read_row(weights[4], part, b, 0, y, 0)
        own, alone, history, mean, share = weights[0], weights[1], weights[2], weights[3], weights[4]
        for x in range(width):
            a, c, d, e = own[x] + offsets[0], alone[x] + offsets[1], history[x] + offsets[2], mean[x] + offsets[3]
            most = max(a, e)
            if share[x] > zero:
                most = max(most, max(c, d))
            a, e = exp(a - most), exp(e - most)
            c, d = share[x] * exp(min(c - most, zero)), share[x] * exp(min(d - most, zero))
            scale = number(1) / (((a + c) + d) + e)
            own[x], alone[x], history[x], mean[x] = a * scale, c * scale, d * scale, e * scale
        for c in range(3):
            row = out[b, c, y]
            read_row(choices[0], predicted, b, c, y, 0)
            read_row(choices[1], images, b, 3 + c, y, 0)
            read_row(choices[2], images, b, 6 + c, y, 0)
            read_row(choices[3], images, b, c, y, 0)
            for x in range(width):
                mixed = own[x] * max(choices[0, x], zero) + alone[x] * choices[1, x]
                row[x] = (mixed + history[x] * choices[2, x]) + mean[x] * choices[3, x]
            expand_values(row)
            for x in range(width):
                row[x] /= factor
