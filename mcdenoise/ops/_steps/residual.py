"""How much of what a denoiser removed is detail, from the correlation of the residual."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.ops._rows import by_rows
from mcdenoise.ops._window import accumulator_dtype, block_means, pad

# Statistics are means over windows of CELLS x CELLS cells of CELL x CELL pixels. Over LAG pixels noise is uncorrelated,
# also under a Gaussian pixel filter. A correlation counts as far as it exceeds DEVIATIONS standard deviations; GAIN is
# the weight per correlation, because detail is correlated only in part over the lag. Differences are relative to a mean
# of at least LEAST_MEAN times the window's.
CELL, CELLS, LAG = 4, 7, 2
DEVIATIONS, GAIN, LEAST_MEAN = 3.0, 4.0, 0.1
# Smallest mean and largest relative difference, so that all derivatives are finite; and smallest variance and power.
DARKEST, MOST = 1e-15, 1e4
LEAST_VARIANCE, LEAST_POWER = 1e-30, 1e-12
# Interpolation and window, twice because of the mean that differences are relative to, and the lag. It is a multiple of
# a cell, so that bands of rows have the cells of the whole image.
REACH = 2 * (CELL + 1 + CELLS // 2 * CELL) + LAG


def weight_of_noisy(color: Tensor, image: Tensor) -> Tensor:
    """Weight of the noisy color beside the denoised image, see :class:`mcdenoise.models.Restored` for its equation.

    Args:
        color: ``(B, 3, H, W)`` noisy radiance.
        image: ``(B, 3, H, W)`` denoised radiance.

    Returns:
        ``(B, 1, H, W)`` in [0, 1]. A pixel depends on those up to :data:`REACH` pixels away.
    """
    dtype = accumulator_dtype(color.dtype)
    return by_rows(_weight, color.to(dtype), image.to(dtype), reach=REACH).to(color.dtype)


def _weight(color: Tensor, image: Tensor) -> Tensor:
    size = color.shape[-2], color.shape[-1]
    bright = image.mean(1, keepdim=True)
    scale = _mean(bright, 3) + LEAST_MEAN * _pixels(_mean(block_means(bright, CELL), CELLS), size)
    r = ((color - image) / scale.clamp_min(DARKEST)).clamp(-MOST, MOST)
    squares, rows, columns = (_product(r, *lag) for lag in ((0, 0), (0, LAG), (LAG, 0)))
    statistics = (squares, rows + columns, rows * rows + columns * columns)
    power, correlation, variance = _mean(block_means(torch.cat(statistics, 1), CELL), CELLS).split(1, 1)
    deviation = variance.clamp_min(LEAST_VARIANCE).sqrt() / (2 * CELL * CELLS)
    weight = GAIN * (correlation / 2 - DEVIATIONS * deviation) / power.clamp_min(LEAST_POWER)
    return _pixels(weight.clamp(0, 1), size)


def _product(r: Tensor, down: int, right: int) -> Tensor:
    """Product of each pixel with the one below or to the right, summed over the channels; 0 where that is outside."""
    height, width = r.shape[2:]
    product = r[..., down:, right:] * r[..., : max(height - down, 0), : max(width - right, 0)]
    return F.pad(product.sum(1, keepdim=True), (0, min(right, width), 0, min(down, height)))


def _pixels(cells: Tensor, size: tuple[int, int]) -> Tensor:
    """Interpolate the means of cells at pixels, linearly along both axes.

    ``torch.nn.functional.interpolate`` and ``torch.lerp`` would round differently in bands of rows.
    """
    for axis in (-1, -2):
        count = cells.shape[axis]
        padded = F.pad(cells, (1, 1, 0, 0) if axis == -1 else (0, 0, 1, 1), mode="replicate")
        before, here, after = (padded.narrow(axis, start, count) for start in range(3))
        (a, b), (c, d) = ([here + w / 8 * (other - here) for w in (3, 1)] for other in (before, after))
        cells = torch.stack([a, b, d, c], axis).flatten(axis - 1, axis)
    return cells[..., : size[0], : size[1]]


def _mean(image: Tensor, side: int) -> Tensor:
    """Means over the window around each pixel; outside the image, its edge is repeated."""
    return F.avg_pool2d(pad(image, side // 2, "replicate"), side, 1)
