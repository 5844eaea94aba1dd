"""The bilateral grid as torch operators with derivatives: pixels are added up in cells, or read out of them.

Each is the derivative of the other. Every thread has rows of cells, or of pixels, of its own, so that none writes to
another one's rows, and each sum has the same order for any number of threads. Two rows of cells are held at a time,
four channels side by side, with an additional cell on each side of the grid and of the bins, which takes all values
beyond and is discarded.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mcdenoise.ops._constants import GUIDE_STEPS, TENT_ROUNDING
from mcdenoise.ops._grid import cells_of, spatial_taps
from mcdenoise.ops._numba._runtime import Source, add_product, compiled, load, read_row, readable, share_rows, source
from mcdenoise.ops._operator import custom_op
from mcdenoise.ops._window import accumulator_dtype

_SIDE_BY_SIDE = 4


class _Guide(NamedTuple):
    """The places of pixels among cells of ``cell`` pixels and ``bins``: the first of two cells per axis, from -1 on."""

    guide: Source
    rows: Any
    row_weights: Any
    columns: Any
    column_weights: Any
    # Factor and offset from the guide to a position among the bins.
    scale: Any
    offset: Any
    cell: int
    bins: int


@custom_op(
    "mcdenoise::grid_splat",
    device_types="cpu",
    schema="(Tensor image, Tensor guide, int cell, int bins) -> (Tensor, Tensor)",
)
def grid_splat(image: Tensor, guide: Tensor, cell: int, bins: int) -> tuple[Tensor, Tensor]:
    """See :func:`mcdenoise.ops.grid_splat`."""
    grid, filled = _splatted(image, True, guide, cell, bins, means=True)
    return grid.to(image.dtype), filled.to(image.dtype)


@grid_splat.register_fake
def _(image: Tensor, guide: Tensor, cell: int, bins: int) -> tuple[Tensor, Tensor]:
    batch, channels, height, width = image.shape
    cells = cells_of(height, cell), cells_of(width, cell), bins
    return image.new_empty((batch, channels, *cells)), image.new_empty((batch, 1, *cells))


def grid_splat_gradients(
    needed: tuple[Any, ...], gradient: Tensor, image: Tensor, guide: Tensor, cell: int, bins: int
) -> tuple[Any, ...]:
    """The derivatives in the image and in the guide, times ``gradient``."""
    return (*_splat_backward(gradient, image, guide, cell, bins), None, None)


@custom_op(
    "mcdenoise::grid_splat_backward",
    device_types="cpu",
    schema="(Tensor gradient, Tensor image, Tensor guide, int cell, int bins) -> (Tensor, Tensor)",
)
def _splat_backward(gradient: Tensor, image: Tensor, guide: Tensor, cell: int, bins: int) -> tuple[Tensor, Tensor]:
    sums, weight = _splatted(image, True, guide, cell, bins, means=False)
    inverse = torch.where(weight > 0, 1 / weight, 0)
    of_sums = gradient.to(sums.dtype) * inverse
    # The derivative in the weight: the mean is a sum times the inverse of the weight.
    of_weight = -(of_sums * sums.mul_(inverse)).sum(1, keepdim=True)
    of_image = torch.zeros(image.shape, dtype=sums.dtype, device="cpu")
    of_guide = _read(of_image, torch.cat([of_sums, of_weight], 1), None, guide, cell, image, of_guide=True)
    return of_image.to(image.dtype), of_guide.to(guide.dtype)


@_splat_backward.register_fake
def _(gradient: Tensor, image: Tensor, guide: Tensor, cell: int, bins: int) -> tuple[Tensor, Tensor]:
    return image.new_empty(image.shape), guide.new_empty(guide.shape)


@custom_op(
    "mcdenoise::grid_slice",
    device_types="cpu",
    schema="(Tensor grid, Tensor filled, Tensor guide, int cell) -> Tensor",
)
def grid_slice(grid: Tensor, filled: Tensor, guide: Tensor, cell: int) -> Tensor:
    """See :func:`mcdenoise.ops.grid_slice`."""
    image = torch.zeros((*grid.shape[:2], *guide.shape[2:]), dtype=accumulator_dtype(grid.dtype), device="cpu")
    _read(image, grid, filled, guide, cell)
    return image.to(grid.dtype)


@grid_slice.register_fake
def _(grid: Tensor, filled: Tensor, guide: Tensor, cell: int) -> Tensor:
    return grid.new_empty((*grid.shape[:2], *guide.shape[2:]))


def grid_slice_gradients(
    needed: tuple[Any, ...], gradient: Tensor, grid: Tensor, filled: Tensor, guide: Tensor, cell: int
) -> tuple[Any, ...]:
    """The derivatives in ``grid``, ``filled`` and ``guide``, times ``gradient``."""
    return (*_slice_backward(gradient, grid, filled, guide, cell), None)


@custom_op(
    "mcdenoise::grid_slice_backward",
    device_types="cpu",
    schema="(Tensor gradient, Tensor grid, Tensor filled, Tensor guide, int cell) -> (Tensor, Tensor, Tensor)",
)
def _slice_backward(
    gradient: Tensor, grid: Tensor, filled: Tensor, guide: Tensor, cell: int
) -> tuple[Tensor, Tensor, Tensor]:
    dtype = accumulator_dtype(grid.dtype)
    batch, channels, *_, bins = grid.shape
    # The derivatives in the sums of values and of weights at each pixel.
    pull = torch.zeros((batch, channels + 1, *guide.shape[2:]), dtype=dtype, device="cpu")
    of_guide = _read(pull, grid, filled, guide, cell, gradient, of_guide=True)
    of_values, of_weight = _splatted(pull, False, guide, cell, bins, means=False)
    of_filled = (of_values * grid).sum(1, keepdim=True).add_(of_weight)
    return of_values.mul_(filled).to(grid.dtype), of_filled.to(filled.dtype), of_guide.to(guide.dtype)


@_slice_backward.register_fake
def _(gradient: Tensor, grid: Tensor, filled: Tensor, guide: Tensor, cell: int) -> tuple[Tensor, Tensor, Tensor]:
    return grid.new_empty(grid.shape), filled.new_empty(filled.shape), guide.new_empty(guide.shape)


def _guide(guide: Tensor, cell: int, bins: int, dtype: torch.dtype) -> _Guide:
    like = torch.empty(0, dtype=dtype, device="cpu")
    (rows, row_weights), (columns, column_weights) = (spatial_taps(side, cell, like) for side in guide.shape[2:])
    line = (GUIDE_STEPS - 1) / GUIDE_STEPS * bins, 0.5 / GUIDE_STEPS * bins - 0.5
    # In the dtype of the sums: numbers in double precision would make the sums so.
    scale, offset = like.new_tensor(line).numpy()
    return _Guide(
        source(readable(guide, dtype)),
        rows[0].numpy(),
        row_weights.numpy(),
        columns[0].numpy(),
        column_weights.numpy(),
        scale,
        offset,
        cell,
        bins,
    )


def _splatted(
    values: Tensor, counted: bool, guide: Tensor, cell: int, bins: int, *, means: bool
) -> tuple[Tensor, Tensor]:
    """Sums in cells, and those of the last channel, which is 1 where pixels are counted.

    With ``means``: those, and which cells are filled.
    """
    dtype = accumulator_dtype(values.dtype)
    batch, channels, height, width = values.shape
    channels += int(counted) - 1
    cells = cells_of(height, cell), cells_of(width, cell), bins
    sums = torch.zeros((batch, channels, *cells), dtype=dtype, device="cpu")
    last = torch.zeros((batch, 1, *cells), dtype=dtype, device="cpu")
    if last.numel():
        arguments = (
            sums.numpy(),
            last.numpy(),
            source(readable(values, dtype)),
            _guide(guide, cell, bins, dtype),
            means,
        )
        share_rows(last.flatten(3), lambda *rows: _splat(*arguments, *rows))
    return sums, last


@compiled
def _splat(sums: Any, last: Any, values: Any, where: Any, means: bool, b: int, first: int, end: int) -> None:
    """Rows ``first`` to ``end`` of cells."""
    height, width, columns = where.rows.size, where.columns.size, last.shape[3]
    channels = sums.shape[1] + 1
    groups = (channels + _SIDE_BY_SIDE - 1) // _SIDE_BY_SIDE
    cells = np.zeros((2, groups, (columns + 2) * (where.bins + 2), _SIDE_BY_SIDE), sums.dtype)
    rows = np.zeros((groups * _SIDE_BY_SIDE, width), sums.dtype)
    rows[channels - 1] = 1
    places, weights, slopes = np.empty(width, np.int64), np.empty((2, width), sums.dtype), np.empty((0, 0), sums.dtype)
    done = first
    for y in range(max((first - 1) * where.cell, 0), min((end + 1) * where.cell, height)):
        top = where.rows[y]
        if top + 1 < first or top >= end:
            continue
        while done < top:
            _hand_out(sums, last, cells[done % 2], means, b, done)
            done += 1
        _place(places, weights, slopes, where, b, y)
        for c in range(values[2]):
            read_row(rows[c], values, b, c, y, 0)
        for v in range(max(top, first), min(top + 2, end)):
            for g in range(groups):
                group = rows[g * _SIDE_BY_SIDE : (g + 1) * _SIDE_BY_SIDE]
                _add_row(cells[v % 2, g], group, places, weights, where, where.row_weights[v - top, y])
    for v in range(done, end):
        _hand_out(sums, last, cells[v % 2], means, b, v)


@compiled
def _add_row(cells: Any, values: Any, places: Any, weights: Any, where: Any, height: float) -> None:
    """A row of pixels in the four cells around each in one row of cells."""
    column_weights, next_column = where.column_weights, where.bins + 2
    for x in range(places.size):
        p0, p1, p2, p3 = values[0, x], values[1, x], values[2, x], values[3, x]
        for side in range(2):
            wide = height * column_weights[side, x]
            i = places[x] + side * next_column
            a, b = wide * weights[0, x], wide * weights[1, x]
            cells[i, 0] += a * p0
            cells[i, 1] += a * p1
            cells[i, 2] += a * p2
            cells[i, 3] += a * p3
            cells[i + 1, 0] += b * p0
            cells[i + 1, 1] += b * p1
            cells[i + 1, 2] += b * p2
            cells[i + 1, 3] += b * p3


@compiled
def _hand_out(sums: Any, last: Any, cells: Any, means: bool, b: int, v: int) -> None:
    """A row of cells that no further pixel adds to; and clear its place."""
    _, channels, _, columns, bins = sums.shape
    zero, one = sums.dtype.type(0), sums.dtype.type(1)
    for u in range(columns):
        start = (u + 1) * (bins + 2) + 1
        weight = last[b, 0, v, u]
        for w in range(bins):
            weight[w] = cells[channels // _SIDE_BY_SIDE, start + w, channels % _SIDE_BY_SIDE]
        for c in range(channels):
            total = sums[b, c, v, u]
            for w in range(bins):
                value = cells[c // _SIDE_BY_SIDE, start + w, c % _SIDE_BY_SIDE]
                total[w] = value / (weight[w] if weight[w] > zero else one) if means else value
        for w in range(bins if means else 0):
            weight[w] = one if weight[w] > zero else zero
    cells[:] = 0


@compiled
def _place(places: Any, weights: Any, slopes: Any, where: Any, b: int, y: int) -> None:
    """Find each pixel's first cell in a row, the weights of that bin and the next, and their slopes if asked for."""
    zero, one, rounding = weights.dtype.type(0), weights.dtype.type(1), weights.dtype.type(TENT_ROUNDING)
    guide = weights[0]
    read_row(guide, where.guide, b, 0, y, 0)
    for x in range(places.size):
        value = guide[x]
        inner = zero if value < zero else one if value > one else value
        position = inner * where.scale + where.offset
        # A NaN is in the first bin, and its weights are NaN.
        w = np.floor(position) if position == position else -one
        places[x] = (where.columns[x] + 1) * (where.bins + 2) + np.int64(w) + 1
        first = position - w
        second = first - one
        a, b_ = np.sqrt(first * first + rounding), np.sqrt(second * second + rounding)
        if slopes.size > 0:
            flat = value < zero or value > one
            slopes[0, x] = zero if flat or a >= one else -first / a * where.scale
            slopes[1, x] = zero if flat or b_ >= one else -second / b_ * where.scale
        weights[0, x] = zero if a > one else one - a
        weights[1, x] = zero if b_ > one else one - b_


def _read(
    out: Tensor,
    grid: Tensor,
    filled: Tensor | None,
    guide: Tensor,
    cell: int,
    beside: Tensor | None = None,
    *,
    of_guide: bool = False,
) -> Tensor:
    """Read a grid at each pixel into ``out``, and with ``of_guide`` return a derivative in the guide.

    With ``filled``, and without ``beside``: means. With ``beside``, their gradient: those of the sums of values and of
    weights. Without ``filled``: sums of all channels of the grid but the last, which go with one that is 1 and those of
    ``beside`` into the derivative.
    """
    dtype = out.dtype
    slope = torch.zeros(guide.shape if of_guide else (0, 0, 0, 0), dtype=dtype, device="cpu")
    if out.numel():
        nothing = torch.empty((0,) * 5, dtype=dtype, device="cpu"), torch.empty((0,) * 4, dtype=dtype, device="cpu")
        arguments = (
            out.numpy(),
            slope.numpy(),
            source(readable(grid, dtype)),
            source(readable(nothing[0] if filled is None else filled, dtype)),
            source(readable(nothing[1] if beside is None else beside, dtype)),
            _guide(guide, cell, grid.shape[4], dtype),
            grid.shape[2],
            grid.shape[3],
        )
        share_rows(out, lambda *rows: _slice(*arguments, *rows))
    return slope


@compiled
def _slice(
    out: Any,
    of_guide: Any,
    grid: Any,
    filled: Any,
    beside: Any,
    where: Any,
    rows_of_cells: int,
    columns: int,
    b: int,
    first: int,
    end: int,
) -> None:
    """Rows ``first`` to ``end`` of pixels."""
    width, dtype = where.columns.size, out.dtype
    # All sums: the last one is that of the weights.
    channels = grid[2] + 1 if filled[2] > 0 else grid[2]
    groups = (channels + _SIDE_BY_SIDE - 1) // _SIDE_BY_SIDE
    cells = np.zeros((2, groups, (columns + 2) * (where.bins + 2), _SIDE_BY_SIDE), dtype)
    sums = np.empty((groups * _SIDE_BY_SIDE, width), dtype)
    steps, given = np.empty_like(sums), np.empty((channels - 1, width), dtype)
    places, weights = np.empty(width, np.int64), np.empty((2, width), dtype)
    slopes = np.empty((2, width if of_guide.size > 0 else 0), dtype)
    zero, one = dtype.type(0), dtype.type(1)
    held = -2
    for y in range(first, end):
        top = where.rows[y]
        if top != held:
            for v in range(top, top + 2):
                # The lower row is the upper one of before.
                if v != held + 1 or held == -2:
                    _fetch(cells[v % 2], grid, filled, b, v, rows_of_cells, columns, where.bins)
            held = top
        _place(places, weights, slopes, where, b, y)
        for g in range(groups):
            part = slice(g * _SIDE_BY_SIDE, (g + 1) * _SIDE_BY_SIDE)
            upper, lower = cells[top % 2, g], cells[(top + 1) % 2, g]
            _read_row(sums[part], steps[part], upper, lower, places, weights, slopes, where, y)
        for c in range(beside[2]):
            read_row(given[c], beside, b, c, y, 0)
        total = sums[channels - 1]
        if of_guide.size == 0:
            for c in range(channels - 1):
                for x in range(width):
                    out[b, c, y, x] = sums[c, x] / (total[x] if total[x] > zero else one)
        elif filled[2] > 0:
            shared, slope = out[b, channels - 1, y], of_guide[b, 0, y]
            for c in range(channels - 1):
                for x in range(width):
                    weight = total[x] if total[x] > zero else one
                    pull = given[c, x] / weight
                    out[b, c, y, x] = pull
                    # An empty pixel is 0 however its weight changes.
                    shared[x] -= pull * (sums[c, x] / weight) if total[x] > zero else zero
                    slope[x] += pull * steps[c, x]
            for x in range(width):
                slope[x] += shared[x] * steps[channels - 1, x]
        else:
            slope = of_guide[b, 0, y]
            slope[:] = steps[channels - 1]
            for c in range(channels - 1):
                out[b, c, y] = sums[c]
                add_product(slope, given[c], steps[c])


@compiled
def _fetch(cells: Any, grid: Any, filled: Any, b: int, v: int, rows: int, columns: int, bins: int) -> None:
    """A row of cells, which may lie beyond the grid; with ``filled`` times that, which is a channel more."""
    if v < 0 or v >= rows:
        cells[:] = 0
        return
    memory, strides, channels = grid
    weights, weight_strides, counted = filled
    for u in range(columns):
        start = (u + 1) * (bins + 2) + 1
        for c in range(channels):
            at = b * strides[0] + c * strides[1] + v * strides[2] + u * strides[3]
            for w in range(bins):
                cells[c // _SIDE_BY_SIDE, start + w, c % _SIDE_BY_SIDE] = load(memory[at + w * strides[4]])
        at = b * weight_strides[0] + v * weight_strides[2] + u * weight_strides[3]
        for w in range(bins if counted else 0):
            weight = load(weights[at + w * weight_strides[4]])
            for c in range(channels):
                cells[c // _SIDE_BY_SIDE, start + w, c % _SIDE_BY_SIDE] *= weight
            cells[channels // _SIDE_BY_SIDE, start + w, channels % _SIDE_BY_SIDE] = weight


@compiled
def _read_row(
    sums: Any,
    steps: Any,
    upper: Any,
    lower: Any,
    places: Any,
    weights: Any,
    slopes: Any,
    where: Any,
    y: int,
) -> None:
    """Four channels of a row: means of the eight cells around each pixel, and how fast they change with the guide."""
    above, below = where.row_weights[0, y], where.row_weights[1, y]
    columns, next_column = where.column_weights, where.bins + 2
    for x in range(places.size):
        i = places[x]
        j = i + next_column
        a, b, c, d = above * columns[0, x], above * columns[1, x], below * columns[0, x], below * columns[1, x]
        p0 = a * upper[i, 0] + b * upper[j, 0] + c * lower[i, 0] + d * lower[j, 0]
        p1 = a * upper[i, 1] + b * upper[j, 1] + c * lower[i, 1] + d * lower[j, 1]
        p2 = a * upper[i, 2] + b * upper[j, 2] + c * lower[i, 2] + d * lower[j, 2]
        p3 = a * upper[i, 3] + b * upper[j, 3] + c * lower[i, 3] + d * lower[j, 3]
        i, j = i + 1, j + 1
        q0 = a * upper[i, 0] + b * upper[j, 0] + c * lower[i, 0] + d * lower[j, 0]
        q1 = a * upper[i, 1] + b * upper[j, 1] + c * lower[i, 1] + d * lower[j, 1]
        q2 = a * upper[i, 2] + b * upper[j, 2] + c * lower[i, 2] + d * lower[j, 2]
        q3 = a * upper[i, 3] + b * upper[j, 3] + c * lower[i, 3] + d * lower[j, 3]
        near, far = weights[0, x], weights[1, x]
        sums[0, x], sums[1, x] = near * p0 + far * q0, near * p1 + far * q1
        sums[2, x], sums[3, x] = near * p2 + far * q2, near * p3 + far * q3
        if slopes.size > 0:
            near, far = slopes[0, x], slopes[1, x]
            steps[0, x], steps[1, x] = near * p0 + far * q0, near * p1 + far * q1
            steps[2, x], steps[3, x] = near * p2 + far * q2, near * p3 + far * q3
