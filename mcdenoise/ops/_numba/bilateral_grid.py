"""The bilateral grid: pixels are added up in cells, or read out of them.

Every thread has rows of cells, or of pixels, of its own, so that none writes to
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
from mcdenoise.ops._grid import spatial_taps
from mcdenoise.ops._numba._runtime import Source, compiled, load, read_row, readable, share_rows, source
from mcdenoise.ops._window import accumulator_dtype, parts_of

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


def grid_splat(image: Tensor, guide: Tensor, cell: int, bins: int) -> tuple[Tensor, Tensor]:
    """See :func:`mcdenoise.ops.grid_splat`."""
    dtype = accumulator_dtype(image.dtype)
    batch, channels, height, width = image.shape
    cells = parts_of(height, cell), parts_of(width, cell), bins
    means = torch.zeros((batch, channels, *cells), dtype=dtype, device="cpu")
    filled = torch.zeros((batch, 1, *cells), dtype=dtype, device="cpu")
    if filled.numel():
        arguments = means.numpy(), filled.numpy(), source(readable(image, dtype)), _guide(guide, cell, bins, dtype)
        share_rows(filled.flatten(3), lambda *rows: _splat(*arguments, *rows))
    return means.to(image.dtype), filled.to(image.dtype)


def grid_slice(grid: Tensor, filled: Tensor, guide: Tensor, cell: int) -> Tensor:
    """See :func:`mcdenoise.ops.grid_slice`."""
    image = torch.zeros((*grid.shape[:2], *guide.shape[2:]), dtype=accumulator_dtype(grid.dtype), device="cpu")
    if image.numel():
        dtype = image.dtype
        sources = source(readable(grid, dtype)), source(readable(filled, dtype))
        arguments = image.numpy(), *sources, _guide(guide, cell, grid.shape[4], dtype), grid.shape[2], grid.shape[3]
        share_rows(image, lambda *rows: _slice(*arguments, *rows))
    return image.to(grid.dtype)


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


@compiled
def _splat(means: Any, filled: Any, image: Any, where: Any, b: int, first: int, end: int) -> None:
    """Rows ``first`` to ``end`` of cells."""
    height, width, columns = where.rows.size, where.columns.size, filled.shape[3]
    channels = means.shape[1] + 1
    groups = (channels + _SIDE_BY_SIDE - 1) // _SIDE_BY_SIDE
    cells = np.zeros((2, groups, (columns + 2) * (where.bins + 2), _SIDE_BY_SIDE), means.dtype)
    rows = np.zeros((groups * _SIDE_BY_SIDE, width), means.dtype)
    rows[channels - 1] = 1
    places, weights = np.empty(width, np.int64), np.empty((2, width), means.dtype)
    done = first
    for y in range(max((first - 1) * where.cell, 0), min((end + 1) * where.cell, height)):
        top = where.rows[y]
        if top + 1 < first or top >= end:
            continue
        while done < top:
            _hand_out(means, filled, cells[done % 2], b, done)
            done += 1
        _place(places, weights, where, b, y)
        for c in range(image[2]):
            read_row(rows[c], image, b, c, y, 0)
        for v in range(max(top, first), min(top + 2, end)):
            for g in range(groups):
                group = rows[g * _SIDE_BY_SIDE : (g + 1) * _SIDE_BY_SIDE]
                _add_row(cells[v % 2, g], group, places, weights, where, where.row_weights[v - top, y])
    for v in range(done, end):
        _hand_out(means, filled, cells[v % 2], b, v)


@compiled
def _add_row(cells: Any, values: Any, places: Any, weights: Any, where: Any, height: float) -> None:
    """A row of pixels in the four cells around each in one row of cells."""
    column_weights, next_column = where.column_weights, where.bins + 2
    for x in range(places.size):
        for side in range(2):
            wide = height * column_weights[side, x]
            i = places[x] + side * next_column
            a, b = wide * weights[0, x], wide * weights[1, x]
            for k in range(_SIDE_BY_SIDE):
                cells[i, k] += a * values[k, x]
                cells[i + 1, k] += b * values[k, x]


@compiled
def _hand_out(means: Any, filled: Any, cells: Any, b: int, v: int) -> None:
    """A row of cells that no further pixel adds to; and clear its place."""
    _, channels, _, columns, bins = means.shape
    zero, one = means.dtype.type(0), means.dtype.type(1)
    for u in range(columns):
        start = (u + 1) * (bins + 2) + 1
        weight = filled[b, 0, v, u]
        for w in range(bins):
            weight[w] = cells[channels // _SIDE_BY_SIDE, start + w, channels % _SIDE_BY_SIDE]
        for c in range(channels):
            mean = means[b, c, v, u]
            for w in range(bins):
                value = cells[c // _SIDE_BY_SIDE, start + w, c % _SIDE_BY_SIDE]
                mean[w] = value / (weight[w] if weight[w] > zero else one)
        for w in range(bins):
            weight[w] = one if weight[w] > zero else zero
    cells[:] = 0


@compiled
def _place(places: Any, weights: Any, where: Any, b: int, y: int) -> None:
    """Find each pixel's first cell in a row, and the weights of that bin and the next."""
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
        weights[0, x] = zero if a > one else one - a
        weights[1, x] = zero if b_ > one else one - b_


@compiled
def _slice(
    out: Any, grid: Any, filled: Any, where: Any, rows_of_cells: int, columns: int, b: int, first: int, end: int
) -> None:
    """Rows ``first`` to ``end`` of pixels."""
    width, dtype = where.columns.size, out.dtype
    # All sums: the last one is that of the weights.
    channels = grid[2] + 1
    groups = (channels + _SIDE_BY_SIDE - 1) // _SIDE_BY_SIDE
    cells = np.zeros((2, groups, (columns + 2) * (where.bins + 2), _SIDE_BY_SIDE), dtype)
    sums = np.empty((groups * _SIDE_BY_SIDE, width), dtype)
    places, weights = np.empty(width, np.int64), np.empty((2, width), dtype)
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
        _place(places, weights, where, b, y)
        for g in range(groups):
            part = sums[g * _SIDE_BY_SIDE : (g + 1) * _SIDE_BY_SIDE]
            _read_row(part, cells[top % 2, g], cells[(top + 1) % 2, g], places, weights, where, y)
        total = sums[channels - 1]
        for c in range(channels - 1):
            for x in range(width):
                out[b, c, y, x] = sums[c, x] / (total[x] if total[x] > zero else one)


@compiled
def _fetch(cells: Any, grid: Any, filled: Any, b: int, v: int, rows: int, columns: int, bins: int) -> None:
    """A row of cells, which may lie beyond the grid, times how far they are filled, which is a channel more."""
    if v < 0 or v >= rows:
        cells[:] = 0
        return
    memory, strides, channels = grid
    weights, weight_strides, _ = filled
    for u in range(columns):
        start = (u + 1) * (bins + 2) + 1
        for c in range(channels):
            at = b * strides[0] + c * strides[1] + v * strides[2] + u * strides[3]
            for w in range(bins):
                cells[c // _SIDE_BY_SIDE, start + w, c % _SIDE_BY_SIDE] = load(memory[at + w * strides[4]])
        at = b * weight_strides[0] + v * weight_strides[2] + u * weight_strides[3]
        for w in range(bins):
            weight = load(weights[at + w * weight_strides[4]])
            for c in range(channels):
                cells[c // _SIDE_BY_SIDE, start + w, c % _SIDE_BY_SIDE] *= weight
            cells[channels // _SIDE_BY_SIDE, start + w, channels % _SIDE_BY_SIDE] = weight


@compiled
def _read_row(sums: Any, upper: Any, lower: Any, places: Any, weights: Any, where: Any, y: int) -> None:
    """Four channels of a row: sums of the eight cells around each pixel."""
    above, below = where.row_weights[0, y], where.row_weights[1, y]
    columns, next_column = where.column_weights, where.bins + 2
    for x in range(places.size):
        i = places[x]
        j = i + next_column
        a, b, c, d = above * columns[0, x], above * columns[1, x], below * columns[0, x], below * columns[1, x]
        near, far = weights[0, x], weights[1, x]
        for k in range(_SIDE_BY_SIDE):
            p = a * upper[i, k] + b * upper[j, k] + c * lower[i, k] + d * lower[j, k]
            q = a * upper[i + 1, k] + b * upper[j + 1, k] + c * lower[i + 1, k] + d * lower[j + 1, k]
            sums[k, x] = near * p + far * q
