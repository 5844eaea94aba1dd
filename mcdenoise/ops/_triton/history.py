"""The steps of a history before and after accumulation, in a few passes, without derivatives."""

from __future__ import annotations

import math
from typing import Any

import torch
import triton
import triton.language as tl
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
)
from mcdenoise.ops._history import Blended
from mcdenoise.ops._operator import custom_op
from mcdenoise.ops._surface import Surface
from mcdenoise.ops._triton._images import is_inside, launch, read_plane, sums_of, tile, write_plane
from mcdenoise.ops._triton.temporal import blended

_FLOOR, _NO_ALBEDO = tl.constexpr(FLOOR), tl.constexpr(NO_ALBEDO)
_EVEN, _BRIGHTER, _WINDOW = tl.constexpr(EVEN), tl.constexpr(BRIGHTER), tl.constexpr(LIGHT_WINDOW)
_SMALLEST, _RECENT_FRAMES = tl.constexpr(SMALLEST_LAG), tl.constexpr(float(RECENT_FRAMES))


def incoming(color: Tensor, albedo: Tensor | None, limit: float | Tensor, kernel_size: int, compared: bool) -> Tensor:
    """See :func:`mcdenoise.ops._steps.history.incoming`."""
    dtype = sums_of(color)
    if isinstance(limit, Tensor):
        limits = limit.to(dtype)
    else:
        limits = torch.full((len(color), 1, 1, 1), limit, dtype=dtype, device=color.device)
    result: Tensor = _enter(color, albedo, limits, kernel_size, compared)
    return result


@custom_op(
    "mcdenoise::triton_incoming",
    schema="(Tensor color, Tensor? albedo, Tensor limits, int kernel_size, bool roots) -> Tensor",
)
def _enter(color: Tensor, albedo: Tensor | None, limits: Tensor, kernel_size: int, roots: bool) -> Tensor:
    result = _empty_entering(color, albedo, limits, kernel_size, roots)
    # A power of two, which rounds nothing: no sum of a window overflows.
    scale = 2.0 ** -(3 * kernel_size**2).bit_length()
    launch(
        _incoming,
        color,
        limits.dtype,
        *(result, color, albedo, limits),
        RADIUS=kernel_size // 2,
        SCALE=scale,
        ALBEDO=albedo is not None,
        ROOTS=roots,
        LARGEST=torch.finfo(limits.dtype).max,
    )
    return result


@_enter.register_fake
def _empty_entering(color: Tensor, albedo: Tensor | None, limits: Tensor, kernel_size: int, roots: bool) -> Tensor:
    batch, channels, height, width = color.shape
    return torch.empty((batch, channels + 2 * roots, height, width), dtype=limits.dtype, device=color.device)


@triton.jit
def _demodulated(
    color: tl.tuple,
    albedo: tl.tuple,
    b: tl.tensor,
    y: tl.tensor,
    x: tl.tensor,
    inside: tl.tensor,
    ALBEDO: tl.constexpr,
    SUM: tl.constexpr,
) -> tl.tuple:
    """Three channels without albedo; 0 where there is no pixel."""
    values = ()
    if ALBEDO:
        # As a tensor: a number beside one, where it is no operator's, would be rounded to float32.
        tints, most, least = (), tl.zeros(inside.shape, SUM), tl.full(inside.shape, _FLOOR, SUM)
        for c in tl.static_range(3):
            tint = read_plane(albedo, b, c, y, x, inside, SUM)
            tints, most = tints + (tint,), tl.maximum(most, tint)
        for c in tl.static_range(3):
            divisor = tl.where(most >= _NO_ALBEDO, tl.maximum(tints[c], least), 1)
            values = values + (read_plane(color, b, c, y, x, inside, SUM) / divisor,)
    else:
        for c in tl.static_range(3):
            values = values + (read_plane(color, b, c, y, x, inside, SUM),)
    return values


@triton.jit
def _incoming(
    out: tl.tuple,
    color: tl.tuple,
    albedo: tl.tuple,
    limits: tl.tuple,
    height: tl.tensor,
    width: tl.tensor,
    RADIUS: tl.constexpr,
    SCALE: tl.constexpr,
    ALBEDO: tl.constexpr,
    ROOTS: tl.constexpr,
    LARGEST: tl.constexpr,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
    WIDE: tl.constexpr,
    SUM: tl.constexpr,
) -> None:
    b, y, x = tile(0, ROWS, COLUMNS, WIDE)
    mine = is_inside(y, x, height, width)
    limit = read_plane(limits, b, 0, y * 0, x * 0, mine, SUM)
    around, lit = tl.zeros([ROWS * COLUMNS], SUM), tl.zeros([ROWS * COLUMNS], SUM)
    for row in range(2 * RADIUS + 1):
        for column in range(2 * RADIUS + 1):
            there_y, there_x = y + row - RADIUS, x + column - RADIUS
            # The pixel itself is never summed: subtracted again, a bright one would take its neighbours' digits.
            other = (row != RADIUS) | (column != RADIUS)
            inside = mine & is_inside(there_y, there_x, height, width) & other
            first, second, third = _demodulated(color, albedo, b, there_y, there_x, inside, ALBEDO, SUM)
            light = SCALE * first + SCALE * second + SCALE * third
            around += light
            lit += tl.where(light > 0, 1, 0).to(SUM)
    values = _demodulated(color, albedo, b, y, x, mine, ALBEDO, SUM)
    own = SCALE * values[0] + SCALE * values[1] + SCALE * values[2]
    largest = tl.full([ROWS * COLUMNS], LARGEST, SUM)
    highest = tl.minimum(around * (tl.minimum(limit, largest) / tl.maximum(lit, 1)), largest)
    bright = (own > highest) & (lit > 0) & (limit <= largest)
    total = tl.zeros([ROWS * COLUMNS], SUM)
    for c in tl.static_range(3):
        value = tl.where(bright, values[c] / tl.where(bright, own, 1) * highest, values[c])
        total += value / 3
        write_plane(out, value, b, c, y, x, mine)
    if ROOTS:
        root = tl.sqrt(tl.sqrt(tl.maximum(total, 0)))
        write_plane(out, root, b, 3, y, x, mine)
        write_plane(out, root * root, b, 4, y, x, mine)


def lights(root: Tensor) -> Tensor:
    """See :func:`mcdenoise.ops._steps.history.lights`."""
    result: Tensor = _find_lights(root)
    return result


@custom_op("mcdenoise::triton_lights", schema="(Tensor root) -> Tensor")
def _find_lights(root: Tensor) -> Tensor:
    result = _empty_lights(root)
    launch(_lights, root, sums_of(root), result, root)
    return result


@_find_lights.register_fake
def _empty_lights(root: Tensor) -> Tensor:
    return torch.empty(root.shape, dtype=root.dtype, device=root.device)


@triton.jit
def _lights(
    found: tl.tuple,
    root: tl.tuple,
    height: tl.tensor,
    width: tl.tensor,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
    WIDE: tl.constexpr,
    SUM: tl.constexpr,
) -> None:
    b, y, x = tile(0, ROWS, COLUMNS, WIDE)
    mine = is_inside(y, x, height, width)
    some = mine & (mine == 0)
    # Blocks of 3x3 pixels of which this is one, by their first row and column.
    for block in range(9):
        top, left = y - block // 3, x - block % 3
        whole = mine & (top >= 0) & (left >= 0) & (top + 2 < height) & (left + 2 < width)
        largest = read_plane(root, b, 0, top, left, whole, SUM)
        smallest = largest
        for pixel in tl.static_range(1, 9):
            value = read_plane(root, b, 0, top + pixel // 3, left + pixel % 3, whole, SUM)
            largest, smallest = tl.maximum(largest, value), tl.minimum(smallest, value)
        some = some | (whole & (largest - smallest <= largest * _EVEN))
    total, count = tl.zeros([ROWS * COLUMNS], SUM), tl.zeros([ROWS * COLUMNS], SUM)
    for row in range(_WINDOW):
        for column in range(_WINDOW):
            there_y, there_x = y + row - _WINDOW // 2, x + column - _WINDOW // 2
            inside = mine & is_inside(there_y, there_x, height, width)
            total += read_plane(root, b, 0, there_y, there_x, inside, SUM)
            count += tl.where(inside, 1, 0).to(SUM)
    bright = read_plane(root, b, 0, y, x, mine, SUM) * count > total * _BRIGHTER
    write_plane(found, tl.where(some & bright, 1, 0).to(SUM), b, 0, y, x, mine)


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
    color, length, histories = blended(
        *(entering, previous, previous_length, motion, surface, previous_surface),
        *(alpha_min, rule, position_limit, normal_limit),
        recent_alpha=recent_alpha,
        albedo=albedo,
        longest=specular_length + 1,
    )
    if not math.isinf(lag_threshold):
        color, length = _discard_lag(color, length, entering, lag_threshold, lag_kernel_size, recent_alpha)
    return Blended(color, length, histories.float().mean((1, 2, 3)))


@custom_op(
    "mcdenoise::triton_discard_lag",
    schema="(Tensor history, Tensor length, Tensor color, float threshold, int kernel_size, float recent_alpha) "
    "-> (Tensor, Tensor)",
)
def _discard_lag(
    history: Tensor, length: Tensor, color: Tensor, threshold: float, kernel_size: int, recent_alpha: float
) -> tuple[Tensor, Tensor]:
    """Discard outdated history: the recent one where the frame contradicts it, the long one where the recent one does.

    Args:
        history: ``(B, 9, H, W)`` color, root and its square, and the recent color and root.
        length: ``(B, 1, H, W)`` of the longer history, in frames.
        color: ``(B, 5, H, W)`` of the current frame, as :func:`incoming` has it.
        threshold: see :func:`mcdenoise.ops.history_lag`.
        kernel_size: likewise, in half the resolution.
        recent_alpha: smallest weight of a frame in the recent history.
    """
    batch, _, height, width = history.shape
    sums = sums_of(history, color)
    # Means over 2x2 pixels: roots of recent history, frame and history; variances of the noise of the first two.
    size = (height + 1) // 2, (width + 1) // 2
    blocks = torch.empty((batch, 5, *size), dtype=sums, device=history.device)
    # How far the recent history lags behind, and its root without that; and how far the history lags.
    lags = torch.empty((batch, 3, *size), dtype=sums, device=history.device)
    longer, shortened = _empty_history(history, length)
    launch(_halve, blocks, sums, blocks, history, length, color, rows=height, columns=width)
    settings: dict[str, Any] = {"THRESHOLD": threshold, "RADIUS": kernel_size // 2}
    launch(_find_lag, blocks, sums, lags, blocks, blocks, RECENT=True, **settings)
    launch(_find_lag, blocks, sums, lags, blocks, lags.clone(), RECENT=False, **settings)
    launch(_discard, history, sums, longer, shortened, history, length, color, lags, SHORTEST=1 / recent_alpha)
    return longer, shortened


@_discard_lag.register_fake
def _empty_history(history: Tensor, length: Tensor, *_: Any) -> tuple[Tensor, Tensor]:
    return (
        torch.empty(history.shape, dtype=history.dtype, device=history.device),
        torch.empty(length.shape, dtype=length.dtype, device=length.device),
    )


@triton.jit
def _between(a: tl.tensor, b: tl.tensor, fraction: tl.tensor) -> tl.tensor:
    """From the nearer end, as torch.lerp does."""
    change = b - a
    return tl.where(fraction < 0.5, a + fraction * change, b - change * (1 - fraction))


@triton.jit
def _variance(
    history: tl.tuple,
    length: tl.tensor,
    b: tl.tensor,
    y: tl.tensor,
    x: tl.tensor,
    inside: tl.tensor,
    SUM: tl.constexpr,
) -> tl.tensor:
    """The variance of the noise of one frame."""
    root, square = read_plane(history, b, 3, y, x, inside, SUM), read_plane(history, b, 4, y, x, inside, SUM)
    counted = tl.maximum(length, 2)
    return tl.maximum(square - root * root, 0) * (counted / (counted - 1))


@triton.jit
def _halve(
    blocks: tl.tuple,
    history: tl.tuple,
    lengths: tl.tuple,
    color: tl.tuple,
    height: tl.tensor,
    width: tl.tensor,
    rows: tl.tensor,
    columns: tl.tensor,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
    WIDE: tl.constexpr,
    SUM: tl.constexpr,
) -> None:
    b, y, x = tile(0, ROWS, COLUMNS, WIDE)
    mine = is_inside(y, x, height, width)
    count, recent, now = (
        tl.zeros([ROWS * COLUMNS], SUM),
        tl.zeros([ROWS * COLUMNS], SUM),
        tl.zeros([ROWS * COLUMNS], SUM),
    )
    long, noise, less = recent, recent, recent
    for pixel in tl.static_range(4):
        there_y, there_x = 2 * y + pixel // 2, 2 * x + pixel % 2
        inside = mine & is_inside(there_y, there_x, rows, columns)
        length = read_plane(lengths, b, 0, there_y, there_x, inside, SUM)
        variance = _variance(history, length, b, there_y, there_x, inside, SUM)
        count += tl.where(inside, 1, 0).to(SUM)
        recent += read_plane(history, b, 8, there_y, there_x, inside, SUM)
        now += read_plane(color, b, 3, there_y, there_x, inside, SUM)
        long += read_plane(history, b, 3, there_y, there_x, inside, SUM)
        noise += variance
        less += variance / tl.maximum(tl.minimum(length, _RECENT_FRAMES), 1)
    count = tl.maximum(count, 1)
    write_plane(blocks, recent / count, b, 0, y, x, mine)
    write_plane(blocks, now / count, b, 1, y, x, mine)
    write_plane(blocks, long / count, b, 2, y, x, mine)
    # A mean's variance is a quarter of the four pixels'.
    write_plane(blocks, noise / count / 4, b, 3, y, x, mine)
    write_plane(blocks, less / count / 4, b, 4, y, x, mine)


@triton.jit
def _find_lag(
    lags: tl.tuple,
    blocks: tl.tuple,
    newer: tl.tuple,
    height: tl.tensor,
    width: tl.tensor,
    THRESHOLD: tl.constexpr,
    RADIUS: tl.constexpr,
    RECENT: tl.constexpr,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
    WIDE: tl.constexpr,
    SUM: tl.constexpr,
) -> None:
    """:func:`mcdenoise.ops.history_lag` of the recent history and the frame; else of the history and the recent one."""
    b, y, x = tile(0, ROWS, COLUMNS, WIDE)
    mine = is_inside(y, x, height, width)
    count = tl.zeros([ROWS * COLUMNS], SUM)
    means, differences, errors = count, count, count
    for row in range(2 * RADIUS + 1):
        for column in range(2 * RADIUS + 1):
            there_y, there_x = y + row - RADIUS, x + column - RADIUS
            inside = mine & is_inside(there_y, there_x, height, width)
            short = read_plane(newer, b, 1, there_y, there_x, inside, SUM)
            long = read_plane(blocks, b, 0 if RECENT else 2, there_y, there_x, inside, SUM)
            means += short
            differences += short - long
            errors += read_plane(blocks, b, 3 if RECENT else 4, there_y, there_x, inside, SUM)
            count += tl.where(inside, 1, 0).to(SUM)
    inverse = 1 / tl.maximum(count, 1)
    mean, difference = means * inverse, differences * inverse
    least = (tl.abs(mean - difference) + tl.abs(mean)) * _SMALLEST / 2
    noise = THRESHOLD * THRESHOLD * (errors * inverse * inverse + least * least)
    some = noise > 0
    ratio = tl.where(some, difference * difference / tl.where(some, noise, 1), 0)
    fraction = tl.minimum(tl.maximum((ratio - 1) / 3, 0), 1)
    if RECENT:
        before, now = read_plane(blocks, b, 0, y, x, mine, SUM), read_plane(blocks, b, 1, y, x, mine, SUM)
        write_plane(lags, fraction, b, 0, y, x, mine)
        write_plane(lags, _between(before, now, fraction), b, 1, y, x, mine)
    else:
        write_plane(lags, fraction, b, 2, y, x, mine)


@triton.jit
def _discard(
    longer: tl.tuple,
    shortened: tl.tuple,
    history: tl.tuple,
    lengths: tl.tuple,
    color: tl.tuple,
    lags: tl.tuple,
    height: tl.tensor,
    width: tl.tensor,
    SHORTEST: tl.constexpr,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
    WIDE: tl.constexpr,
    SUM: tl.constexpr,
) -> None:
    b, y, x = tile(0, ROWS, COLUMNS, WIDE)
    mine = is_inside(y, x, height, width)
    length = read_plane(lengths, b, 0, y, x, mine, SUM)
    little = read_plane(lags, b, 0, y // 2, x // 2, mine, SUM)
    much = read_plane(lags, b, 2, y // 2, x // 2, mine, SUM)
    for c in tl.static_range(4):
        now = read_plane(color, b, c, y, x, mine, SUM)
        recent = _between(read_plane(history, b, 5 + c, y, x, mine, SUM), now, little)
        write_plane(longer, recent, b, 5 + c, y, x, mine)
        write_plane(longer, _between(read_plane(history, b, c, y, x, mine, SUM), recent, much), b, c, y, x, mine)
        if c == 3:
            square = recent * recent + _variance(history, length, b, y, x, mine, SUM)
            before = read_plane(history, b, 4, y, x, mine, SUM)
            write_plane(longer, _between(before, square, much), b, 4, y, x, mine)
    write_plane(shortened, _between(length, tl.minimum(length, SHORTEST), much), b, 0, y, x, mine)
