"""The steps of a history before and after accumulation, on a CPU.

Plain torch makes dozens of passes over the image; here each row is finished while it is in the cache.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mcdenoise.ops._constants import (
    BRIGHTER,
    EVEN,
    LAG_WINDOW,
    LIGHT_WINDOW,
    RECENT_ALPHA,
    RECENT_FRAMES,
    RELIT_BLOCK,
    SMALLEST_LAG,
)
from mcdenoise.ops._history import Blended, root_changes
from mcdenoise.ops._numba._runtime import add, compiled, read_row, share_rows, source
from mcdenoise.ops._numba.temporal import between, blended
from mcdenoise.ops._surface import Surface
from mcdenoise.ops._window import parts_of

_RADIUS = LAG_WINDOW // 2


def lights(root: Tensor) -> Tensor:
    """See :func:`mcdenoise.ops._steps.history.lights`."""
    found = torch.zeros_like(root, memory_format=torch.contiguous_format)
    if min(root.shape[-2:]) > 2 and len(root):
        arguments = (found.numpy(), source(root), *root.new_tensor([EVEN, BRIGHTER]).numpy(), LIGHT_WINDOW // 2)
        share_rows(root, lambda *rows: _lights(*arguments, *rows), light=True)
    return found


@compiled
def _lights(found: Any, root: Any, even: float, brighter: float, radius: int, b: int, first: int, last: int) -> None:
    _, _, height, width = found.shape
    number = found.dtype.type
    one, zero = number(1), number(0)
    size = 2 * radius + 1
    # The rows of the window, and the maximum and minimum of three successive pixels, at the last of them.
    ring, brightest, darkest = np.empty((3, size, width), found.dtype)
    alike, column = np.zeros(width + 2, found.dtype), np.zeros(width + 2 * radius, found.dtype)
    middle, total = column[radius : radius + width], np.empty(width, found.dtype)
    for ahead in range(max(first - radius, 0), last + radius):
        if ahead < height:
            values, high, low = ring[ahead % size], brightest[ahead % size], darkest[ahead % size]
            read_row(values, root, b, 0, ahead, 0)
            for x in range(2, width):
                high[x] = max(values[x - 2], max(values[x - 1], values[x]))
                low[x] = min(values[x - 2], min(values[x - 1], values[x]))
        y = ahead - radius
        if y < first:
            continue
        top, bottom = max(y - radius, 0), min(y + radius + 1, height)
        middle[:], total[:] = zero, zero
        for row in range(top, bottom):
            add(middle, ring[row % size])
        for d in range(size):
            add(total, column[d : d + width])
        here, out = ring[y % size], found[b, 0, y]
        for start in range(max(y - 2, 0), min(y + 1, height - 2)):
            r0, r1, r2 = start % size, (start + 1) % size, (start + 2) % size
            for x in range(2, width):
                largest = max(brightest[r0, x], max(brightest[r1, x], brightest[r2, x]))
                smallest = min(darkest[r0, x], min(darkest[r1, x], darkest[r2, x]))
                alike[x] = one if largest - smallest <= even * largest else zero
            for x in range(width):
                out[x] = max(out[x], max(alike[x], max(alike[x + 1], alike[x + 2])))
        for x in range(width):
            count = number((bottom - top) * (min(x + radius + 1, width) - max(x - radius, 0)))
            out[x] = out[x] if here[x] * count > brighter * total[x] else zero


def blend(
    entering: Tensor,
    previous: Tensor,
    previous_length: Tensor,
    motion: Tensor | None,
    surface: Surface | None,
    previous_surface: Surface | None,
    alpha_min: float,
    albedo: Tensor | None,
    specular_length: float,
    lag_threshold: float,
) -> Blended:
    """See :func:`mcdenoise.ops._steps.history.blend`."""
    recent_alpha = max(alpha_min, RECENT_ALPHA)
    color, length, counts = blended(
        *(entering, previous, previous_length, motion, surface, previous_surface, alpha_min),
        recent_alpha=recent_alpha,
        albedo=albedo,
        longest=specular_length + 1,
    )
    if not math.isinf(lag_threshold):
        _discard_lag(color, length, entering, lag_threshold, recent_alpha)
        _follow_light(color, length, entering)
    return Blended(color, length, counts.sum(1) / max(length.shape[-2] * length.shape[-1], 1))


def _discard_lag(history: Tensor, length: Tensor, color: Tensor, threshold: float, recent_alpha: float) -> None:
    """Discard outdated history: the recent one where the frame contradicts it, the long one where the recent one does.

    Args:
        history: ``(B, 9, H, W)`` contiguous: color, root and its square, and the recent color and root; changed.
        length: ``(B, 1, H, W)`` contiguous, of the longer history, in frames; changed.
        color: ``(B, 5, H, W)`` of the current frame, as :func:`incoming` has it.
        threshold: see :func:`mcdenoise.ops.history_lag`.
        recent_alpha: smallest weight of a frame in the recent history.
    """
    batch, _, height, width = history.shape
    # For blocks of four pixels: the roots of recent history, frame and history; the variances of the first two's noise;
    # the recent history without lag; and both fractions.
    halves = history.new_empty((batch, 8, (height + 1) // 2, (width + 1) // 2))
    if not halves.numel():
        return
    settings = history.new_tensor([threshold, SMALLEST_LAG, recent_alpha, RECENT_FRAMES]).numpy()
    limits, alpha, frames = settings[:2], settings[2], settings[3]
    blocks, images = halves.numpy(), (history.numpy(), length.numpy(), color.to(history.dtype).contiguous().numpy())
    share_rows(halves, lambda *rows: _halve(blocks, *images, frames, *rows), light=True)
    share_rows(halves, lambda *rows: _find_recent_lag(blocks, *limits, *rows), light=True)
    share_rows(halves, lambda *rows: _find_lag(blocks, *images, *limits, alpha, *rows), light=True)


@compiled
def _variance(variance: Any, root: Any, square: Any, length: Any) -> None:
    """The variance of the noise of one frame, in a row."""
    zero, one, two = variance.dtype.type(0), variance.dtype.type(1), variance.dtype.type(2)
    for x in range(variance.size):
        counted = max(length[x], two)
        variance[x] = max(square[x] - root[x] * root[x], zero) * (counted / (counted - one))


@compiled
def _halve(
    halves: Any, history: Any, lengths: Any, color: Any, recent_frames: float, b: int, first: int, last: int
) -> None:
    _, _, height, width = history.shape
    _, _, _, columns = halves.shape
    number = halves.dtype.type
    # Sums of two rows; where the width is odd, the last column is there twice.
    rows, variance = np.empty((5, 2 * columns), halves.dtype), np.empty(width, halves.dtype)
    for y in range(first, last):
        count = min(2 * y + 2, height) - 2 * y
        rows[:] = 0
        for row in range(2 * y, 2 * y + count):
            length = lengths[b, 0, row]
            _variance(variance, history[b, 3, row], history[b, 4, row], length)
            add(rows[0, :width], history[b, 8, row])
            add(rows[1, :width], color[b, 3, row])
            add(rows[2, :width], history[b, 3, row])
            add(rows[3, :width], variance)
            for x in range(width):
                variance[x] /= min(length[x], recent_frames)
            add(rows[4, :width], variance)
        if width % 2:
            for k in range(5):
                rows[k, width] = rows[k, width - 1]
        for k in range(5):
            # A mean's variance is a quarter of the four pixels'.
            part, block, pixels = number((0.5 if k < 3 else 0.125) / count), halves[b, k, y], rows[k]
            for x in range(columns):
                block[x] = part * (pixels[2 * x] + pixels[2 * x + 1])


@compiled
def _lag(
    fraction: Any,
    sums: Any,
    history: Any,
    recent: Any,
    variance: Any,
    threshold: float,
    smallest: float,
    y: int,
) -> None:
    """One row of :func:`mcdenoise.ops.history_lag`; ``sums`` has room for three with ``_RADIUS`` more at both ends."""
    height, width = history.shape
    number = fraction.dtype.type
    zero, one, half, third = number(0), number(1), number(0.5), number(1 / 3)
    top, bottom = max(y - _RADIUS, 0), min(y + _RADIUS + 1, height)
    means, differences, errors = np.zeros((3, width), fraction.dtype)
    sums[:] = 0
    recents, changes, noises = sums[:, _RADIUS : _RADIUS + width]
    for row in range(top, bottom):
        long, short = history[row], recent[row]
        for x in range(width):
            recents[x] += short[x]
            changes[x] += short[x] - long[x]
        add(noises, variance[row])
    for d in range(2 * _RADIUS + 1):
        add(means, sums[0, d : d + width])
        add(differences, sums[1, d : d + width])
        add(errors, sums[2, d : d + width])
    square = threshold * threshold
    for x in range(width):
        inverse = one / number((bottom - top) * (min(x + _RADIUS + 1, width) - max(x - _RADIUS, 0)))
        mean, difference = means[x] * inverse, differences[x] * inverse
        least = smallest * (abs(mean - difference) + abs(mean)) * half
        noise = square * (errors[x] * inverse * inverse + least * least)
        ratio = difference * difference / noise if noise > zero else zero
        fraction[x] = min(max((ratio - one) * third, zero), one)


@compiled
def _find_recent_lag(halves: Any, threshold: float, smallest: float, b: int, first: int, last: int) -> None:
    """How far the recent history lags behind the frame, and its root without that."""
    width = halves.shape[3]
    sums = np.empty((3, width + 2 * _RADIUS), halves.dtype)
    recent, current, variance = halves[b, 0], halves[b, 1], halves[b, 3]
    for y in range(first, last):
        fraction, root, before, now = halves[b, 6, y], halves[b, 5, y], recent[y], current[y]
        _lag(fraction, sums, recent, current, variance, threshold, smallest, y)
        for x in range(width):
            root[x] = between(before[x], now[x], fraction[x])


@compiled
def _find_lag(
    halves: Any,
    history: Any,
    lengths: Any,
    color: Any,
    threshold: float,
    smallest: float,
    recent_alpha: float,
    b: int,
    first: int,
    last: int,
) -> None:
    """How far the history lags behind the recent one; both without their lag."""
    _, _, height, width = history.shape
    columns = halves.shape[3]
    sums, variance = np.empty((3, columns + 2 * _RADIUS), halves.dtype), np.empty(width, halves.dtype)
    number = halves.dtype.type
    zero, shortest = number(0), number(1) / recent_alpha
    for y in range(first, last):
        recent_fraction, fraction = halves[b, 6, y], halves[b, 7, y]
        _lag(fraction, sums, halves[b, 2], halves[b, 5], halves[b, 4], threshold, smallest, y)
        for row in range(2 * y, min(2 * y + 2, height)):
            length = lengths[b, 0, row]
            _variance(variance, history[b, 3, row], history[b, 4, row], length)
            # Most pixels keep their history.
            for x in range(width):
                little, much = recent_fraction[x >> 1], fraction[x >> 1]
                if not (little > zero or much > zero):
                    continue
                for c in range(4):
                    recent = between(history[b, 5 + c, row, x], color[b, c, row, x], little)
                    history[b, 5 + c, row, x] = recent
                    history[b, c, row, x] = between(history[b, c, row, x], recent, much)
                square = history[b, 8, row, x] * history[b, 8, row, x] + variance[x]
                history[b, 4, row, x] = between(history[b, 4, row, x], square, much)
                length[x] = between(length[x], min(length[x], shortest), much)


def _follow_light(history: Tensor, length: Tensor, color: Tensor) -> None:
    """Scale both histories by the change of the light, see :func:`mcdenoise.ops._history.light_changes`.

    Args:
        history: ``(B, 9, H, W)`` contiguous; changed.
        length: ``(B, 1, H, W)`` contiguous.
        color: ``(B, 5, H, W)`` of the current frame, as :func:`incoming` has it.
    """
    batch, _, height, width = history.shape
    blocks = history.new_empty((batch, 4, parts_of(height, RELIT_BLOCK), parts_of(width, RELIT_BLOCK)))
    if not blocks.numel():
        return
    images = history.numpy(), length.numpy(), color.to(history.dtype).contiguous().numpy()
    share_rows(blocks, lambda *rows: _mean_blocks(blocks.numpy(), *images, *rows), light=True)
    factors = root_changes(blocks, height, width)
    # In most frames the light has not changed.
    if factors.ne(1).any():
        share_rows(history, lambda *rows: _scale(*images[:2], factors.numpy(), *rows), light=True)


@compiled
def _mean_blocks(blocks: Any, history: Any, lengths: Any, color: Any, b: int, first: int, last: int) -> None:
    _, _, height, width = history.shape
    columns = blocks.shape[3]
    number = blocks.dtype.type
    sums, variance = np.empty((4, width), blocks.dtype), np.empty(width, blocks.dtype)
    for block in range(first, last):
        top, bottom = block * RELIT_BLOCK, min((block + 1) * RELIT_BLOCK, height)
        sums[:] = 0
        for y in range(top, bottom):
            add(sums[0], history[b, 3, y])
            add(sums[1], history[b, 8, y])
            add(sums[2], color[b, 3, y])
            _variance(variance, history[b, 3, y], history[b, 4, y], lengths[b, 0, y])
            add(sums[3], variance)
        for column in range(columns):
            left, right = column * RELIT_BLOCK, min((column + 1) * RELIT_BLOCK, width)
            for k in range(4):
                total = number(0)
                for x in range(left, right):
                    total += sums[k, x]
                blocks[b, k, block, column] = total / number((bottom - top) * (right - left))


@compiled
def _scale(history: Any, lengths: Any, factors: Any, b: int, first: int, last: int) -> None:
    """Multiply the channels of both histories by powers of their roots' factors, bilinearly interpolated."""
    width = history.shape[3]
    _, _, rows, columns = factors.shape
    number = history.dtype.type
    half, one, zero = number(0.5), number(1), number(0)
    row = np.empty(columns + 1, history.dtype)
    for y in range(first, last):
        place = max((number(y) + half) / number(RELIT_BLOCK) - half, zero)
        above = int(place)
        below, down = min(above + 1, rows - 1), place - number(above)
        for k in range(2):
            for column in range(columns):
                row[column] = between(factors[b, k, above, column], factors[b, k, below, column], down)
            row[columns] = row[columns - 1]
            # Channels: color, root and square of the whole history; color and root of the recent one.
            start, root = (0, 3) if k == 0 else (5, 8)
            for x in range(width):
                across = max((number(x) + half) / number(RELIT_BLOCK) - half, zero)
                before = int(across)
                factor = between(row[before], row[before + 1], across - number(before))
                if lengths[b, 0, y, x] > one and factor != one:
                    square = factor * factor
                    history[b, root, y, x] *= factor
                    if k == 0:
                        history[b, 4, y, x] *= square
                    for c in range(start, start + 3):
                        history[b, c, y, x] *= square * square
