"""The steps of a history before and after accumulation, as torch operators without derivatives.

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
    FLOOR,
    LIGHT_WINDOW,
    NO_ALBEDO,
    RECENT_ALPHA,
    RECENT_FRAMES,
    SMALLEST_LAG,
    STILL,
)
from mcdenoise.ops._history import Blended
from mcdenoise.ops._numba._runtime import add, compiled, copy_row, share_rows, source
from mcdenoise.ops._numba.temporal import Shorter, blended
from mcdenoise.ops._operator import custom_op
from mcdenoise.ops._surface import Surface


def incoming(color: Tensor, albedo: Tensor | None, limit: float | Tensor, kernel_size: int, compared: bool) -> Tensor:
    """See :func:`mcdenoise.ops._steps.history.incoming`."""
    dtype = torch.promote_types(color.dtype, torch.float32)
    if isinstance(limit, Tensor):
        limits = limit.to(dtype).flatten()
    else:
        limits = color.new_full((len(color),), limit, dtype=dtype)
    result: Tensor = _enter(color, albedo, limits, kernel_size, compared)
    return result


def lights(root: Tensor) -> Tensor:
    """See :func:`mcdenoise.ops._steps.history.lights`."""
    result: Tensor = _find_lights(root, EVEN, BRIGHTER, LIGHT_WINDOW)
    return result


def blend(
    entering: Tensor,
    previous: Tensor,
    previous_length: Tensor,
    motion: Tensor | None,
    surface: Surface | None,
    previous_surface: Surface | None,
    alpha_min: float,
    rule: str,
    position_limit: float | None,
    normal_limit: float | None,
    albedo: Tensor | None,
    specular_length: float,
    lag_threshold: float,
    lag_kernel_size: int,
) -> Blended:
    """See :func:`mcdenoise.ops._steps.history.blend`."""
    recent_alpha = max(alpha_min, RECENT_ALPHA)
    color, length, counts = blended(
        *(entering, previous, previous_length, motion, surface, previous_surface),
        *(alpha_min, rule, position_limit, normal_limit),
        Shorter(recent_alpha, albedo, specular_length + 1, STILL),
    )
    if not math.isinf(lag_threshold):
        _discard_lag(color, length, entering, lag_threshold, lag_kernel_size, recent_alpha, RECENT_FRAMES)
    return Blended(color, length, counts.sum(1) / max(length.shape[-2] * length.shape[-1], 1))


@custom_op(
    "mcdenoise::incoming",
    device_types="cpu",
    schema="(Tensor color, Tensor? albedo, Tensor limits, int kernel_size, bool roots) -> Tensor",
)
def _enter(color: Tensor, albedo: Tensor | None, limits: Tensor, kernel_size: int, roots: bool) -> Tensor:
    """With the limit of each image, in the dtype of the result."""
    dtype = limits.dtype
    batch, channels, height, width = color.shape
    out = torch.empty((batch, channels + 2 * roots, height, width), dtype=dtype, device="cpu")
    nothing = torch.empty((0, 0, 0, 0), dtype=dtype, device="cpu")
    images = (source((nothing if image is None else image).to(dtype)) for image in (color, albedo))
    settings = out.new_tensor([FLOOR, NO_ALBEDO]).numpy()
    arguments = (out.numpy(), *images, *settings, limits.detach().contiguous().numpy(), kernel_size // 2, roots)
    share_rows(color, lambda *rows: _incoming(*arguments, *rows), light=True)
    return out


@_enter.register_fake
def _(color: Tensor, albedo: Tensor | None, limits: Tensor, kernel_size: int, roots: bool) -> Tensor:
    batch, channels, height, width = color.shape
    return color.new_empty((batch, channels + 2 * roots, height, width), dtype=limits.dtype)


@compiled
def _demodulate(
    row: Any, divisor: Any, color: Any, albedo: Any, floor: float, no_albedo: float, b: int, y: int
) -> None:
    """One row of all channels."""
    channels, width = row.shape
    strides = color[1]
    for c in range(channels):
        copy_row(row[c], color, b * strides[0] + c * strides[1] + y * strides[2], strides[3])
    _, strides, tints = albedo
    if tints == 0:
        return
    most = divisor[channels]
    for c in range(channels):
        tint = divisor[c]
        copy_row(tint, albedo, b * strides[0] + c * strides[1] + y * strides[2], strides[3])
        for x in range(width):
            most[x] = tint[x] if c == 0 else max(most[x], tint[x])
    one = row.dtype.type(1)
    for c in range(channels):
        values, tint = row[c], divisor[c]
        for x in range(width):
            values[x] /= max(tint[x], floor) if most[x] >= no_albedo else one


@compiled
def _incoming(
    out: Any,
    color: Any,
    albedo: Any,
    floor: float,
    no_albedo: float,
    limits: Any,
    radius: int,
    roots: bool,
    b: int,
    first: int,
    last: int,
) -> None:
    """Rows ``first`` to ``last``; those around a row wait in a ring as long as its windows need them."""
    _, _, height, width = out.shape
    channels, size = color[2], 2 * radius + 1
    number, limit = out.dtype.type, limits[b]
    clamps = limit < number(np.inf)
    reach = radius if clamps else 0
    one, zero = number(1), number(0)
    ring, divisor = np.empty((size, channels, width), out.dtype), np.empty((channels + 1, width), out.dtype)
    # Brightness and whether there is any, with a margin; the sums of them beside each pixel, and those with the pixel.
    light = np.zeros((2, size, width + 2 * radius), out.dtype)
    beside, across = np.zeros((2, size, width), out.dtype), np.zeros((2, size, width), out.dtype)
    around = np.empty((2, width), out.dtype)
    highest, lit = around[0], around[1]
    # A power of two, which rounds nothing: no sum of a window overflows.
    scale = one
    while channels * size * size * scale >= one:
        scale *= number(0.5)
    for ahead in range(first - reach, last + reach):
        place = ahead % size
        inside = 0 <= ahead < height
        if inside:
            _demodulate(ring[place], divisor, color, albedo, floor, no_albedo, b, ahead)
        if clamps:
            beside[:, place] = 0
            across[:, place] = 0
            if inside:
                inner, found = light[0, place, radius : radius + width], light[1, place, radius : radius + width]
                inner[:] = 0
                for c in range(channels):
                    values = ring[place, c]
                    for x in range(width):
                        inner[x] += scale * values[x]
                for x in range(width):
                    found[x] = one if inner[x] > zero else zero
                for k in range(2):
                    sides, whole = beside[k, place], across[k, place]
                    for d in range(size):
                        if d != radius:
                            add(sides, light[k, place, d : d + width])
                    whole[:] = light[k, place, radius : radius + width]
                    add(whole, sides)
        y = ahead - reach
        if y < first:
            continue
        here = y % size
        if clamps:
            for k in range(2):
                total = around[k]
                total[:] = beside[k, here]
                for dy in range(1, radius + 1):
                    above, below = across[k, (y - dy) % size], across[k, (y + dy) % size]
                    for x in range(width):
                        total[x] += above[x] + below[x]
            inner = light[0, here, radius : radius + width]
            for x in range(width):
                # Without a lit neighbour a pixel is its own limit.
                highest[x] = highest[x] * (limit / lit[x]) if lit[x] > zero else inner[x]
            for c in range(channels):
                values, clamped = ring[here, c], out[b, c, y]
                for x in range(width):
                    clamped[x] = values[x] / inner[x] * highest[x] if inner[x] > highest[x] else values[x]
        else:
            for c in range(channels):
                out[b, c, y] = ring[here, c]
        if roots:
            root, square = out[b, channels, y], out[b, channels + 1, y]
            root[:] = 0
            for c in range(channels):
                values = out[b, c, y]
                for x in range(width):
                    root[x] += values[x]
            for x in range(width):
                root[x] = math.sqrt(math.sqrt(max(root[x] / number(channels), zero)))
                square[x] = root[x] * root[x]


@custom_op(
    "mcdenoise::lights",
    device_types="cpu",
    schema="(Tensor root, float even, float brighter, int window) -> Tensor",
)
def _find_lights(root: Tensor, even: float, brighter: float, window: int) -> Tensor:
    """Find lights: blocks of 3x3 pixels that are alike and brighter than the window around them.

    Args:
        root: ``(B, 1, H, W)`` fourth root of the radiance, float32 or float64.
        even: how far the pixels of a block may differ, relative to the brightest of them.
        brighter: a light is brighter than this many times the mean of its window.
        window: side of the window in pixels, odd, at least 5.
    """
    found = root.new_zeros(root.shape)
    if min(root.shape[-2:]) > 2 and len(root):
        arguments = (found.numpy(), source(root), *root.new_tensor([even, brighter]).numpy(), window // 2)
        share_rows(root, lambda *rows: _lights(*arguments, *rows), light=True)
    return found


@_find_lights.register_fake
def _(root: Tensor, *_: Any) -> Tensor:
    return root.new_empty(root.shape)


@compiled
def _lights(found: Any, root: Any, even: float, brighter: float, radius: int, b: int, first: int, last: int) -> None:
    _, _, height, width = found.shape
    number, strides = found.dtype.type, root[1]
    one, zero = number(1), number(0)
    size = 2 * radius + 1
    # The rows of the window, and the maximum and minimum of three successive pixels, at the last of them.
    ring, brightest, darkest = np.empty((3, size, width), found.dtype)
    alike, column = np.zeros(width + 2, found.dtype), np.zeros(width + 2 * radius, found.dtype)
    middle, total = column[radius : radius + width], np.empty(width, found.dtype)
    for ahead in range(max(first - radius, 0), last + radius):
        if ahead < height:
            values, high, low = ring[ahead % size], brightest[ahead % size], darkest[ahead % size]
            copy_row(values, root, b * strides[0] + ahead * strides[2], strides[3])
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


@custom_op(
    "mcdenoise::give_up_lag",
    device_types="cpu",
    schema="(Tensor(a!) history, Tensor(b!) length, Tensor color, float threshold, int kernel_size, "
    "float recent_alpha, float recent_frames) -> ()",
)
def _discard_lag(
    history: Tensor,
    length: Tensor,
    color: Tensor,
    threshold: float,
    kernel_size: int,
    recent_alpha: float,
    recent_frames: float,
) -> None:
    """Discard outdated history: the recent one where the frame contradicts it, the long one where the recent one does.

    Args:
        history: ``(B, 9, H, W)`` contiguous: color, root and its square, and the recent color and root; changed.
        length: ``(B, 1, H, W)`` contiguous, of the longer history, in frames; changed.
        color: ``(B, 5, H, W)`` contiguous, of the current frame, as :func:`incoming` has it.
        threshold: see :func:`mcdenoise.ops.history_lag`.
        kernel_size: likewise, in half the resolution.
        recent_alpha: smallest weight of a frame in the recent history.
        recent_frames: as many equally weighted frames have its noise.
    """
    batch, _, height, width = history.shape
    # For blocks of four pixels: the roots of recent history, frame and history; the variances of the first two's noise;
    # the recent history without lag; and both fractions.
    halves = history.new_empty((batch, 8, (height + 1) // 2, (width + 1) // 2))
    settings = history.new_tensor([threshold, SMALLEST_LAG, recent_alpha, recent_frames]).numpy()
    limits, alpha, frames = settings[:2], settings[2], settings[3]
    blocks, image, lengths, radius = halves.numpy(), history.numpy(), length.numpy(), kernel_size // 2
    share_rows(halves, lambda *rows: _halve(blocks, image, lengths, color.numpy(), frames, *rows), light=True)
    share_rows(halves, lambda *rows: _find_recent_lag(blocks, *limits, radius, *rows), light=True)
    share_rows(
        halves,
        lambda *rows: _find_lag(blocks, image, lengths, color.numpy(), *limits, alpha, radius, *rows),
        light=True,
    )


@_discard_lag.register_fake
def _(history: Tensor, *_: Any) -> None:
    return None


@compiled
def _between(a: float, b: float, fraction: float) -> float:
    """From the nearer end, as torch.lerp does."""
    one, change = type(a)(1), b - a
    return a + fraction * change if fraction + fraction < one else b - change * (one - fraction)


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
    radius: int,
    y: int,
) -> None:
    """One row of :func:`mcdenoise.ops.history_lag`; ``sums`` has room for three with ``radius`` more at both ends."""
    height, width = history.shape
    number = fraction.dtype.type
    zero, one, half, third = number(0), number(1), number(0.5), number(1 / 3)
    top, bottom = max(y - radius, 0), min(y + radius + 1, height)
    means, differences, errors = np.zeros((3, width), fraction.dtype)
    sums[:] = 0
    recents, changes, noises = sums[:, radius : radius + width]
    for row in range(top, bottom):
        long, short = history[row], recent[row]
        for x in range(width):
            recents[x] += short[x]
            changes[x] += short[x] - long[x]
        add(noises, variance[row])
    for d in range(2 * radius + 1):
        add(means, sums[0, d : d + width])
        add(differences, sums[1, d : d + width])
        add(errors, sums[2, d : d + width])
    square = threshold * threshold
    for x in range(width):
        inverse = one / number((bottom - top) * (min(x + radius + 1, width) - max(x - radius, 0)))
        mean, difference = means[x] * inverse, differences[x] * inverse
        least = smallest * (abs(mean - difference) + abs(mean)) * half
        noise = square * (errors[x] * inverse * inverse + least * least)
        ratio = difference * difference / noise if noise > zero else zero
        fraction[x] = min(max((ratio - one) * third, zero), one)


@compiled
def _find_recent_lag(
    halves: Any, threshold: float, smallest: float, radius: int, b: int, first: int, last: int
) -> None:
    """How far the recent history lags behind the frame, and its root without that."""
    width = halves.shape[3]
    sums = np.empty((3, width + 2 * radius), halves.dtype)
    recent, current, variance = halves[b, 0], halves[b, 1], halves[b, 3]
    for y in range(first, last):
        fraction, root, before, now = halves[b, 6, y], halves[b, 5, y], recent[y], current[y]
        _lag(fraction, sums, recent, current, variance, threshold, smallest, radius, y)
        for x in range(width):
            root[x] = _between(before[x], now[x], fraction[x])


@compiled
def _find_lag(
    halves: Any,
    history: Any,
    lengths: Any,
    color: Any,
    threshold: float,
    smallest: float,
    recent_alpha: float,
    radius: int,
    b: int,
    first: int,
    last: int,
) -> None:
    """How far the history lags behind the recent one; both without their lag."""
    _, _, height, width = history.shape
    columns = halves.shape[3]
    sums, variance = np.empty((3, columns + 2 * radius), halves.dtype), np.empty(width, halves.dtype)
    number = halves.dtype.type
    zero, shortest = number(0), number(1) / recent_alpha
    for y in range(first, last):
        recent_fraction, fraction = halves[b, 6, y], halves[b, 7, y]
        _lag(fraction, sums, halves[b, 2], halves[b, 5], halves[b, 4], threshold, smallest, radius, y)
        for row in range(2 * y, min(2 * y + 2, height)):
            length = lengths[b, 0, row]
            _variance(variance, history[b, 3, row], history[b, 4, row], length)
            # Most pixels keep their history.
            for x in range(width):
                little, much = recent_fraction[x >> 1], fraction[x >> 1]
                if not (little > zero or much > zero):
                    continue
                for c in range(4):
                    recent = _between(history[b, 5 + c, row, x], color[b, c, row, x], little)
                    history[b, 5 + c, row, x] = recent
                    history[b, c, row, x] = _between(history[b, c, row, x], recent, much)
                square = history[b, 8, row, x] * history[b, 8, row, x] + variance[x]
                history[b, 4, row, x] = _between(history[b, 4, row, x], square, much)
                length[x] = _between(length[x], min(length[x], shortest), much)
