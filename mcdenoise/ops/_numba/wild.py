"""The steps before and behind the networks of ``wild`` on a CPU: one pass each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mcdenoise.ops._constants import BLOCK, FLOOR, MAX_RADIANCE, NO_ALBEDO, RECENT_ALPHA
from mcdenoise.ops._numba._runtime import compiled, exp, read_row, rounded, share_rows, source
from mcdenoise.ops._numba.transfer import compress_values, expand_values
from mcdenoise.ops._window import computing_dtype, parts_of

_FIGURES = 19


def wild_figures(
    alone: Tensor,
    recent: Tensor,
    history: Tensor,
    albedo: Tensor | None,
    normal: Tensor | None,
    length: Tensor,
    exposure: Tensor,
) -> Any:
    """See :func:`mcdenoise.ops._steps.wild.wild_figures`."""
    buffers = (alone, recent, history, *_features(alone, albedo, normal), length, exposure.expand(len(alone), 1, 1, 1))
    if not _are_alike(*buffers):
        return NotImplemented
    size = (parts_of(side, BLOCK) for side in alone.shape[2:])
    figures = torch.empty((len(alone), _FIGURES, *size), dtype=alone.dtype, device="cpu")
    if figures.numel():
        arguments = (figures.numpy(), *map(source, buffers), *alone.shape[2:])
        # An image of as many rows as there are rows of blocks.
        share_rows(alone[..., : figures.shape[2], :], lambda *rows: _figure_rows(*arguments, *rows))
    return figures


def wild_input(
    alone: Tensor,
    recent: Tensor,
    history: Tensor,
    albedo: Tensor | None,
    normal: Tensor | None,
    length: Tensor,
    logits: Tensor,
    exposure: Tensor,
    multiple: int,
) -> Any:
    """See :func:`mcdenoise.ops._steps.wild.wild_input`."""
    dtype = computing_dtype(alone)
    factor = exposure.expand(len(alone), 1, 1, 1)
    buffers = (alone, recent, history, *_features(alone, albedo, normal), length, factor)
    if dtype == torch.float16 or not _are_alike(*buffers) or logits.dtype != alone.dtype:
        return NotImplemented
    batch, _, height, width = alone.shape
    rows, columns = (parts_of(side, multiple) * multiple for side in (height, width))
    seen = torch.empty((batch, 16, rows, columns), dtype=dtype, memory_format=torch.channels_last, device="cpu")
    seen[..., height:, :], seen[..., width:] = 0, 0
    images, mixed = (torch.empty((batch, n, height, width), dtype=alone.dtype, device="cpu") for n in (9, 1))
    if images.numel():
        arguments = (source(seen), images.numpy(), mixed.numpy(), *map(source, buffers), logits.contiguous().numpy())
        share_rows(alone, lambda *rows: _input_rows(*arguments, *rows))
    return seen, images, mixed


def wild_choice(
    predicted: Tensor,
    images: Tensor,
    part: Tensor,
    albedo: Tensor | None,
    exposure: Tensor,
    offsets: Sequence[float],
    pace: float,
) -> Any:
    """See :func:`mcdenoise.ops._steps.wild.wild_choice`."""
    factor = exposure.expand(len(images), 1, 1, 1)
    read = (predicted, images, part, _features(images[:, :3], albedo, None)[0], factor)
    if not _are_alike(*read):
        return NotImplemented
    result = torch.empty((len(images), 3, *images.shape[2:]), dtype=images.dtype, device="cpu")
    if result.numel():
        arguments = (result.numpy(), *map(source, read), np.array([*offsets, pace], result.numpy().dtype))
        share_rows(images, lambda *rows: _choice_rows(*arguments, *rows))
    return result


def _features(image: Tensor, albedo: Tensor | None, normal: Tensor | None) -> tuple[Tensor, Tensor]:
    """Albedo and normal, or in the place of one a single number that is read for every pixel."""
    one, zero = (image.new_full((1, 1, 1, 1), value).expand_as(image) for value in (1, 0))
    return one if albedo is None else albedo, zero if normal is None else normal


def _are_alike(*images: Tensor) -> bool:
    """Whether all have one dtype that is supported, and all but the last, the exposure, the same batch and size."""
    first, dtype = images[0], images[0].dtype
    same_size = all((len(image), *image.shape[2:]) == (len(first), *first.shape[2:]) for image in images[:-1])
    return dtype in (torch.float32, torch.float64) and all(image.dtype == dtype for image in images) and same_size


@compiled
def _figure_rows(
    out: Any,
    alone: Any,
    recent: Any,
    history: Any,
    albedo: Any,
    normal: Any,
    length: Any,
    exposure: Any,
    height: int,
    width: int,
    b: int,
    first: int,
    last: int,
) -> None:
    # The 14 images of which blocks have means: 4 on the scale, normal, 3 differences, part, and 3 of radiance.
    rows, lit = np.empty((14, BLOCK, out.shape[3] * BLOCK), out.dtype), np.empty((3, 3, width), out.dtype)
    scale, frames = np.empty((3, width), out.dtype), np.empty(width, out.dtype)
    factor = exposure[0][b * exposure[1][0]]
    for block in range(first, last):
        for i in range(BLOCK):
            y = min(block * BLOCK + i, height - 1)
            read_row(frames, length, b, 0, y, 0)
            for c in range(3):
                read_row(scale[c], albedo, b, c, y, 0)
                read_row(rows[4 + c, i, :width], normal, b, c, y, 0)
            _show_features(rows, i, scale, frames)
            _modulate(scale, factor)
            for c in range(3):
                _exposed(lit[c], alone, recent, history, frames, scale[c], b, c, y)
            _show_light(rows, i, lit)
            for k in range(14):
                rows[k, i, width:] = rows[k, i, width - 1]
        _reduce(out, rows, b, block)


@compiled
def _show_features(rows: Any, i: int, albedo: Any, length: Any) -> None:
    """A row of the albedo, the normal, and the part of the history."""
    number = rows.dtype.type
    zero, one, third = number(0), number(1), number(1 / 3)
    for x in range(length.size):
        rows[3, i, x] = zero
        rows[10, i, x] = one - one / max(length[x], one)
    for c in range(3):
        for x in range(length.size):
            rows[3, i, x] += min(max(albedo[c, x], zero), one) * third
            rows[4 + c, i, x] = min(max(rows[4 + c, i, x], -one), one)


@compiled
def _show_light(rows: Any, i: int, lit: Any) -> None:
    """A row of the three images, on the scale and as radiance, and of their differences; ``lit`` is overwritten."""
    number = rows.dtype.type
    third, most, zero = number(1 / 3), number(MAX_RADIANCE), number(0)
    for k in range(3):
        values, total = rows[k, i], rows[11 + k, i]
        values[:], total[:] = zero, zero
        for c in range(3):
            light = lit[c, k]
            for x in range(light.size):
                light[x] = min(light[x], most)
                total[x] += light[x] * third
            compress_values(light)
            for x in range(light.size):
                values[x] += light[x] * third
    for x in range(lit.shape[2]):
        own, near, far = rows[0, i, x], rows[1, i, x], rows[2, i, x]
        rows[7, i, x], rows[8, i, x], rows[9, i, x] = abs(own - far), abs(near - far), abs(own - near)


@compiled
def _reduce(out: Any, rows: Any, b: int, block: int) -> None:
    """A row of blocks: the means, and the variances of the first seven, of which those of the normal are added."""
    number = out.dtype.type
    zero, share = number(0), number(1 / BLOCK**2)
    out[b, 18, block] = zero
    for k in range(14):
        means, variances = out[b, k, block], out[b, min(14 + k, 18), block]
        for x in range(means.size):
            total = zero
            for i in range(BLOCK):
                for j in range(BLOCK):
                    total += rows[k, i, x * BLOCK + j]
            means[x] = total * share
        for x in range(means.size if k < 7 else 0):
            total = zero
            for i in range(BLOCK):
                for j in range(BLOCK):
                    difference = rows[k, i, x * BLOCK + j] - means[x]
                    total += difference * difference
            variances[x] = total * share + (variances[x] if k > 4 else zero)


@compiled
def _modulate(scale: Any, factor: Any) -> None:
    """From rows of albedo to what radiance without it is multiplied by, see :func:`mcdenoise.ops.remodulate`."""
    number = scale.dtype.type
    least, none, one = number(FLOOR), number(NO_ALBEDO), number(1)
    for x in range(scale.shape[1]):
        textured = scale[0, x] >= none or scale[1, x] >= none or scale[2, x] >= none
        for c in range(3):
            scale[c, x] = factor * (max(scale[c, x], least) if textured else one)


@compiled
def _exposed(lit: Any, alone: Any, recent: Any, history: Any, length: Any, scale: Any, b: int, c: int, y: int) -> None:
    """A row of a channel of the three images; without a history all are the frame."""
    own, near, far = lit[0], lit[1], lit[2]
    read_row(own, alone, b, c, y, 0)
    read_row(near, recent, b, c, y, 0)
    read_row(far, history, b, c, y, 0)
    for x in range(own.size):
        old = length[x] > 1
        near[x] = scale[x] * (near[x] if old else own[x])
        far[x] = scale[x] * (far[x] if old else own[x])
        own[x] *= scale[x]


@compiled
def _input_rows(
    out: Any,
    images: Any,
    mixed: Any,
    alone: Any,
    recent: Any,
    history: Any,
    albedo: Any,
    normal: Any,
    length: Any,
    exposure: Any,
    logits: Any,
    b: int,
    first: int,
    last: int,
) -> None:
    memory, strides, channels = out
    number = images.dtype.type
    zero, one, half, most = number(0), number(1), number(0.5), number(1 / RECENT_ALPHA)
    width = images.shape[3]
    factor = exposure[0][b * exposure[1][0]]
    rows = np.empty((channels, width), memory.dtype)
    scale, lit = np.empty((3, width), images.dtype), np.empty((3, width), images.dtype)
    values, weights = np.empty(width, images.dtype), np.empty((2, logits.shape[3] * BLOCK), images.dtype)
    trust, whole = weights[0], weights[1]
    for y in range(first, last):
        _weigh(weights, logits, b, y)
        for c in range(3):
            read_row(scale[c], albedo, b, c, y, 0)
            for x in range(width):
                values[x] = min(max(scale[c, x], zero), one)
            _round_row(rows[3 + c], values)
            read_row(values, normal, b, c, y, 0)
            for x in range(width):
                values[x] = min(max(values[x], -one), one) * half + half
            _round_row(rows[6 + c], values)
        _modulate(scale, factor)
        read_row(values, length, b, 0, y, 0)
        for c in range(3):
            mean, own, old = images[b, c, y], images[b, 3 + c, y], images[b, 6 + c, y]
            _exposed(lit, alone, recent, history, values, scale[c], b, c, y)
            for x in range(width):
                old[x] = lit[1, x] + whole[x] * (lit[2, x] - lit[1, x])
                own[x] = lit[0, x]
                mean[x] = lit[0, x] + trust[x] * (old[x] - lit[0, x])
            compress_values(mean)
            compress_values(own)
            compress_values(old)
            _round_row(rows[c], mean)
            _round_row(rows[9 + c], own)
            _round_row(rows[12 + c], old)
        row = mixed[b, 0, y]
        for x in range(width):
            near = one - one / max(min(values[x], most), one)
            far = one - one / max(values[x], one)
            row[x] = near + whole[x] * (far - near)
        _round_row(rows[15], row)
        start = b * strides[0] + y * strides[2]
        _interleave(memory[start : start + width * channels], rows)


@compiled
def _weigh(weights: Any, logits: Any, b: int, y: int) -> None:
    """The weights of a row of pixels, from the logits of the blocks whose centres are around."""
    number = weights.dtype.type
    one, half, side = number(1), BLOCK // 2, number(BLOCK)
    _, count, rows, columns = logits.shape
    place = (y + number(0.5)) / side - number(0.5)
    above = int(max(place, number(0)))
    low, below = max(place, number(0)) - above, min(above + 1, rows - 1)
    blocks = np.empty(columns, weights.dtype)
    for k in range(count):
        for x in range(columns):
            blocks[x] = logits[b, k, above, x] + low * (logits[b, k, below, x] - logits[b, k, above, x])
        row = weights[k]
        row[:half], row[-half:] = blocks[0], blocks[-1]
        for j in range(BLOCK):
            right = (j + number(0.5)) / side
            for x in range(columns - 1):
                row[x * BLOCK + half + j] = blocks[x] + right * (blocks[x + 1] - blocks[x])
        for x in range(row.size):
            row[x] = one / (one + exp(-row[x]))


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
def _choice_rows(
    out: Any,
    predicted: Any,
    images: Any,
    part: Any,
    albedo: Any,
    exposure: Any,
    numbers: Any,
    b: int,
    first: int,
    last: int,
) -> None:
    number = out.dtype.type
    zero = number(0)
    width = out.shape[3]
    pace, scale = numbers[4], np.empty((3, width), out.dtype)
    factor = exposure[0][b * exposure[1][0]]
    weights, choices = np.empty((5, width), out.dtype), np.empty((4, width), out.dtype)
    for y in range(first, last):
        for k in range(4):
            read_row(weights[k], predicted, b, 3 + k, y, 0)
        read_row(weights[4], part, b, 0, y, 0)
        for c in range(3):
            read_row(scale[c], albedo, b, c, y, 0)
        _modulate(scale, factor)
        own, alone, history, mean, share = weights[0], weights[1], weights[2], weights[3], weights[4]
        for x in range(width):
            a, c = pace * own[x] + numbers[0], pace * alone[x] + numbers[1]
            d, e = pace * history[x] + numbers[2], pace * mean[x] + numbers[3]
            most = max(a, e)
            if share[x] > zero:
                most = max(most, max(c, d))
            a, e = exp(a - most), exp(e - most)
            c, d = share[x] * exp(min(c - most, zero)), share[x] * exp(min(d - most, zero))
            whole = number(1) / (((a + c) + d) + e)
            own[x], alone[x], history[x], mean[x] = a * whole, c * whole, d * whole, e * whole
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
                row[x] /= scale[c, x]
