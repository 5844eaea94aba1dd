"""The weight of the noisy color on a CPU: three passes over the pixels, where torch takes some eighty."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from mcdenoise.ops._constants import (
    CELL,
    CELLS,
    DARKEST,
    DEVIATIONS,
    GAIN,
    LAG,
    LEAST_MEAN,
    LEAST_POWER,
    LEAST_VARIANCE,
    MOST,
)
from mcdenoise.ops._numba._runtime import add, add_product, compiled, read_row, share_rows, source
from mcdenoise.ops._operator import custom_op

_RADIUS = CELLS // 2


def weight_of_noisy(color: Tensor, image: Tensor) -> Any:
    """See :func:`mcdenoise.ops._steps.residual.weight_of_noisy`."""
    is_alike = color.shape == image.shape and color.dtype == image.dtype
    is_supported = color.ndim == 4 and color.dtype in (torch.float32, torch.float64)
    return _weight(color, image) if is_alike and is_supported else NotImplemented


@custom_op("mcdenoise::weight_of_noisy", device_types="cpu", schema="(Tensor color, Tensor image) -> Tensor")
def _weight(color: Tensor, image: Tensor) -> Tensor:
    weight = _empty_plane(color, image)
    if not weight.numel():
        return weight
    batch, _, height, width = color.shape
    bright = color.new_empty(batch, 1, height, width).numpy()
    cells = color.new_empty(batch, 3, -(-height // CELL), -(-width // CELL))
    sums, means, out = cells.numpy(), torch.empty_like(cells).numpy(), weight.numpy()
    noisy, denoised = source(color), source(image)
    share_rows(color, lambda *rows: _brightness(sums, bright, denoised, *rows), light=True, step=CELL)
    share_rows(cells, lambda *rows: _windows(means[:, :1], sums[:, :1], *rows), light=True)
    share_rows(color, lambda *rows: _statistics(sums, noisy, denoised, bright, means, *rows), step=CELL)
    share_rows(cells, lambda *rows: _windows(means, sums, *rows), light=True)
    share_rows(cells, lambda *rows: _weights(sums, means, *rows), light=True)
    share_rows(color, lambda *rows: _interpolate(out, sums, *rows), light=True)
    return weight


@_weight.register_fake
def _empty_plane(color: Tensor, image: Tensor) -> Tensor:
    return color.new_empty(color.shape[0], 1, *color.shape[2:])


@compiled
def _brightness(cells: Any, bright: Any, image: Any, b: int, first: int, last: int) -> None:
    """Means over the channels, and those over cells in the first channel of ``cells``."""
    row = np.empty(bright.shape[3], bright.dtype)
    for y in range(first, last):
        total = bright[b, 0, y]
        read_row(total, image, b, 0, y, 0)
        for c in range(1, image[2]):
            read_row(row, image, b, c, y, 0)
            add(total, row)
        for x in range(total.size):
            total[x] /= image[2]
        if y % CELL == 0:
            cells[b, 0, y // CELL] = 0
        _add_to_cells(cells[b, 0, y // CELL], total)
        if y == last - 1 or y % CELL == CELL - 1:
            _to_means(cells[b, 0, y // CELL], row.size, y % CELL + 1)


@compiled
def _add_to_cells(cells: Any, row: Any) -> None:
    whole = row.size // CELL
    for j in range(whole):
        cells[j] += (row[CELL * j] + row[CELL * j + 1]) + (row[CELL * j + 2] + row[CELL * j + 3])
    for x in range(whole * CELL, row.size):
        cells[whole] += row[x]


@compiled
def _to_means(cells: Any, width: int, rows: int) -> None:
    """Divide sums over cells, of which the last row and column may have fewer pixels."""
    for j in range(cells.size):
        cells[j] /= min(CELL, width - CELL * j) * rows


@compiled
def _windows(out: Any, cells: Any, b: int, first: int, last: int) -> None:
    """Means over the window around each cell; outside the image, its edge is repeated."""
    height, width = cells.shape[2:]
    padded = np.empty(width + CELLS - 1, cells.dtype)
    for c in range(out.shape[1]):
        for y in range(first, last):
            middle = padded[_RADIUS : _RADIUS + width]
            middle[:] = 0
            for dy in range(-_RADIUS, _RADIUS + 1):
                add(middle, cells[b, c, min(max(y + dy, 0), height - 1)])
            padded[:_RADIUS], padded[_RADIUS + width :] = middle[0], middle[width - 1]
            mean = out[b, c, y]
            mean[:] = 0
            for dx in range(CELLS):
                add(mean, padded[dx : dx + width])
            for x in range(width):
                mean[x] /= CELLS * CELLS


@compiled
def _statistics(out: Any, color: Any, image: Any, bright: Any, means: Any, b: int, first: int, last: int) -> None:
    """Means over cells of power, correlation and variance, see :func:`mcdenoise.ops._steps.residual._weight`."""
    height, width = bright.shape[2:]
    channels = color[2]
    differences = np.empty((CELL + LAG, channels, width), bright.dtype)
    scratch = np.empty((2, width + 2), bright.dtype)
    coarse = np.empty(means.shape[3], bright.dtype)
    squares, rows, columns = np.empty((3, width), bright.dtype)
    for top in range(first, last, CELL):
        # The last rows of the previous cells are the first ones of these.
        start = 0 if top == first else LAG
        if start:
            for k in range(LAG):
                differences[k] = differences[CELL + k]
        for k in range(start, min(CELL + LAG, height - top)):
            _relative_differences(differences[k], color, image, bright[b, 0], means[b, 0], scratch, coarse, b, top + k)
        cells = out[b, :, top // CELL]
        cells[:] = 0
        count = min(CELL, height - top)
        for k in range(count):
            squares[:], rows[:], columns[:] = 0, 0, 0
            for c in range(channels):
                here = differences[k, c]
                add_product(squares, here, here)
                if width > LAG:
                    add_product(rows[: width - LAG], here[: width - LAG], here[LAG:])
                if top + k + LAG < height:
                    add_product(columns, here, differences[k + LAG, c])
            _add_to_cells(cells[0], squares)
            for x in range(width):
                along, down = rows[x], columns[x]
                rows[x], columns[x] = along + down, along * along + down * down
            _add_to_cells(cells[1], rows)
            _add_to_cells(cells[2], columns)
        for c in range(3):
            _to_means(cells[c], width, count)


@compiled
def _relative_differences(
    out: Any, color: Any, image: Any, bright: Any, means: Any, scratch: Any, coarse: Any, b: int, y: int
) -> None:
    """One row of ``(color - image) / mean(image)``."""
    number = out.dtype.type
    height, width = bright.shape
    padded, scale = scratch[0], scratch[1, :width]
    total = padded[1 : width + 1]
    above, here, below = bright[max(y - 1, 0)], bright[y], bright[min(y + 1, height - 1)]
    for x in range(width):
        total[x] = above[x] + here[x] + below[x]
    padded[0], padded[width + 1] = total[0], total[width - 1]
    _interpolate_row(scale, means, coarse, y)
    for x in range(width):
        mean = (padded[x] + padded[x + 1] + padded[x + 2]) / number(9) + number(LEAST_MEAN) * scale[x]
        scale[x] = number(1) / max(mean, number(DARKEST))
    for c in range(out.shape[0]):
        row = out[c]
        read_row(row, color, b, c, y, 0)
        read_row(total, image, b, c, y, 0)
        for x in range(width):
            row[x] = min(max((row[x] - total[x]) * scale[x], number(-MOST)), number(MOST))


@compiled
def _weights(out: Any, means: Any, b: int, first: int, last: int) -> None:
    number = out.dtype.type
    for y in range(first, last):
        power, correlation, variance = means[b, 0, y], means[b, 1, y], means[b, 2, y]
        weight = out[b, 0, y]
        for x in range(weight.size):
            deviation = np.sqrt(max(variance[x], number(LEAST_VARIANCE))) / number(2 * CELL * CELLS)
            excess = number(GAIN) * (correlation[x] / number(2) - number(DEVIATIONS) * deviation)
            weight[x] = min(max(excess / max(power[x], number(LEAST_POWER)), number(0)), number(1))


@compiled
def _interpolate(out: Any, cells: Any, b: int, first: int, last: int) -> None:
    coarse = np.empty(cells.shape[3], cells.dtype)
    for y in range(first, last):
        _interpolate_row(out[b, 0, y], cells[b, 0], coarse, y)


@compiled
def _interpolate_row(row: Any, cells: Any, coarse: Any, y: int) -> None:
    """A row of pixels, linearly interpolated from the means of cells of 4x4 pixels."""
    number = row.dtype.type
    far, near = number(3 / 8), number(1 / 8)
    rows, columns = cells.shape
    phase, i = y % CELL, y // CELL
    here, other = cells[i], cells[max(i - 1, 0) if phase < CELL // 2 else min(i + 1, rows - 1)]
    part = far if phase in (0, CELL - 1) else near
    for j in range(columns):
        coarse[j] = here[j] + part * (other[j] - here[j])
    for j in range(row.size // CELL):
        before, middle, after = coarse[max(j - 1, 0)], coarse[j], coarse[min(j + 1, columns - 1)]
        row[CELL * j] = middle + far * (before - middle)
        row[CELL * j + 1] = middle + near * (before - middle)
        row[CELL * j + 2] = middle + near * (after - middle)
        row[CELL * j + 3] = middle + far * (after - middle)
    for x in range(row.size // CELL * CELL, row.size):
        before, middle = coarse[max(columns - 2, 0)], coarse[columns - 1]
        # The last cell has no neighbour to the right.
        to_left = far if x % CELL == 0 else near if x % CELL == 1 else number(0)
        row[x] = middle + to_left * (before - middle)
