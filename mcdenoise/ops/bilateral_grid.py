"""The bilateral grid: an image as coarse cells in space and in the range of a guide, and the way back."""

from __future__ import annotations

import torch
from torch import Tensor

from mcdenoise.ops._check import check_least
from mcdenoise.ops._constants import GUIDE_STEPS
from mcdenoise.ops._grid import spatial_taps, tent
from mcdenoise.ops._module import module_of
from mcdenoise.ops._op import op
from mcdenoise.ops._window import accumulator_dtype, parts_of

CELL, BINS = 8, 32


def _check_settings(cell: int, bins: int = BINS) -> None:
    check_least(1, cell=cell, bins=bins)


def _check_slice(grid: Tensor, guide: Tensor, cell: int) -> None:
    found, size = tuple(grid.shape[2:4]), tuple(guide.shape[2:])
    _check_settings(cell, grid.shape[4])
    expected = tuple(parts_of(side, cell) for side in size)
    if found != expected:
        raise ValueError(
            f"grid: expected {expected} rows and columns for a guide of {size} in cells of {cell}, found {found}"
        )


@op("numba", check=_check_settings, image="B C H W", guide="B 1 H W")
def grid_splat(image: Tensor, guide: Tensor, *, cell: int = CELL, bins: int = BINS) -> tuple[Tensor, Tensor]:
    """Average an image in the cells of a bilateral grid: blocks of pixels, separated by the value of a guide.

    ``grid[v, u, w] = sum_p a[p] image[p] / sum_p a[p]`` over the pixels ``p = (x, y)`` with, for ``z = 255 guide[p]``,

    ``a[p] = t((x + 0.5) / cell - (u + 0.5)) t((y + 0.5) / cell - (v + 0.5)) t((z + 0.5) bins / 256 - (w + 0.5))``

    and the tent ``t(x) = max(1 - sqrt(x^2 + 1e-8), 0)``: every pixel is in up to eight cells. Where the size is no
    multiple of ``cell``, the last cells extend beyond the image and contain only its pixels.

    kornia has no bilateral grid. That of Chen et al. 2007 puts a pixel into the nearest cell and blurs the grid
    afterwards; :func:`mcdenoise.ops.cross_bilateral_filter` compares each pixel with its neighbours at full
    resolution, in a window that costs its area, where a grid costs eight cells a pixel at any size.

    Args:
        image: ``(B, C, H, W)``, any unit, from 0 to 1e34 in magnitude.
        guide: ``(B, 1, H, W)`` in [0, 1]; values beyond count as 0 or 1.
        cell: side of a cell in pixels, at least 1: the ``s_s`` of the paper.
        bins: cells along the guide's range, at least 1: 256 over the ``s_r`` of the paper.

    Returns:
        ``(B, C, ceil(H / cell), ceil(W / cell), bins)`` means, 0 in cells without a pixel, and
        ``(B, 1, ceil(H / cell), ceil(W / cell), bins)`` whether a cell has one: 1 or 0. Both in the dtype of ``image``.
        Half precision is computed in float32. On the CPU, the same bits each time.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: a shape or a setting does not fit.

    Differentiable in ``image`` and ``guide``, to any order, where no guide is below 0 or above 1 or at the end of a
    tent: which cells are empty has no derivative. The derivative in a guide is large where only the tail of a tent
    reaches a cell; the authors set derivatives above 100 to 0.

    Source: Meng et al. 2020, "Real-Time Monte Carlo Denoising with the Neural Bilateral Grid", Sec. 4, and its public
    code; the grid itself: Chen, Paris and Durand 2007, "Real-time edge-aware image processing with the bilateral grid".

    Example:
        >>> image = torch.tensor([[[[1.0, 1.0, 5.0, 5.0]]]])
        >>> grid, filled = grid_splat(image, torch.tensor([[[[0.0, 0.0, 1.0, 1.0]]]]), cell=4, bins=2)
        >>> grid.flatten().tolist(), filled.flatten().tolist()
        ([1.0, 5.0], [1.0, 1.0])
    """
    dtype = accumulator_dtype(image.dtype)
    rows, columns = (parts_of(side, cell) for side in image.shape[-2:])
    index, weight = _taps(guide.to(dtype), cell, rows, columns, bins)
    values = torch.cat([image.to(dtype), torch.ones_like(guide, dtype=dtype)], 1)
    source = (values[:, :, None] * weight[:, None]).flatten(2)
    empty = source.new_zeros(*source.shape[:2], rows * columns * bins)
    total = empty.scatter_add(2, index[:, None].expand(source.shape), source)
    total = total.reshape(*total.shape[:2], rows, columns, bins)
    filled = total[:, -1:] > 0
    grid = total[:, :-1] / torch.where(filled, total[:, -1:], 1)
    return grid.to(image.dtype), filled.to(image.dtype)


@op(
    "numba",
    check=_check_slice,
    grid="B C rows columns bins",
    filled="B 1 rows columns bins",
    guide="B 1 H W",
)
def grid_slice(grid: Tensor, filled: Tensor, guide: Tensor, *, cell: int = CELL) -> Tensor:
    """Read an image out of a bilateral grid: at each pixel the mean of the eight cells around its place and its guide.

    ``out[p] = sum_k a_k[p] filled[k] grid[k] / sum_k a_k[p] filled[k]`` with the weights ``a`` of :func:`grid_splat`,
    which are those of trilinear interpolation; 0 where all eight are empty. So an image is smoothed where the guide is
    constant, and pixels whose guides differ by at least two bins do not mix.

    Args:
        grid: ``(B, C, ceil(H / cell), ceil(W / cell), bins)``, any unit, from 0 to 1e34 in magnitude.
        filled: ``(B, 1, ceil(H / cell), ceil(W / cell), bins)`` weight of each cell in [0, 1]: 0 for empty cells.
        guide: ``(B, 1, H, W)`` in [0, 1], of any resolution; values beyond count as 0 or 1.
        cell: side of a cell in pixels, at least 1.

    Returns:
        ``(B, C, H, W)`` in the dtype of ``grid``. Half precision is computed in float32.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: a shape or a setting does not fit.

    Differentiable in ``grid``, ``filled`` and ``guide``, to any order, where no guide is below 0 or above 1 or at the
    centre of a bin, and not all cells around a pixel are empty.

    Source: Meng et al. 2020, as :func:`grid_splat`. Their code treats cells of the value 0 as empty, even if they
    contain black pixels: at the edge of a black area its result is brighter.

    Example:
        >>> image, guide = torch.rand(1, 3, 9, 11), torch.rand(1, 1, 9, 11)
        >>> same = grid_slice(*grid_splat(torch.full_like(image, 2), guide), guide)
        >>> bool((same - 2).abs().max() < 1e-6)
        True
    """
    dtype = accumulator_dtype(grid.dtype)
    index, weight = _taps(guide.to(dtype), cell, *grid.shape[2:])
    known = filled.to(dtype)
    cells = torch.cat([grid.to(dtype) * known, known], 1).flatten(2)
    total = cells.new_zeros(())
    # One after the other, which a cache can hold: all eight at once take three times as long.
    for places, weights in zip(index.unflatten(1, (8, -1)).unbind(1), weight.flatten(2).unbind(1), strict=True):
        found = cells.gather(2, places[:, None].expand(-1, cells.shape[1], -1))
        total = total + found * weights[:, None]
    total = total.unflatten(2, guide.shape[-2:])
    image: Tensor = total[:, :-1] / torch.where(total[:, -1:] > 0, total[:, -1:], 1)
    return image.to(grid.dtype)


def _taps(guide: Tensor, cell: int, rows: int, columns: int, bins: int) -> tuple[Tensor, Tensor]:
    """The eight cells around each pixel and its guide.

    Returns:
        ``(B, 8 H W)`` their places in a flattened grid, and ``(B, 8, H, W)`` their weights, 0 beyond the grid.
    """
    height, width = guide.shape[-2:]
    v, row_weight = spatial_taps(height, cell, guide)
    u, column_weight = spatial_taps(width, cell, guide)
    position = guide[:, 0].clamp(0, 1) * ((GUIDE_STEPS - 1) / GUIDE_STEPS * bins) + (0.5 / GUIDE_STEPS * bins - 0.5)
    first = position.floor()
    w = torch.stack([first, first + 1], 1)
    bin_weight = tent(position[:, None] - w) * ((w >= 0) & (w < bins))
    place = (v.clamp(0, rows - 1)[:, None, :, None] * columns + u.clamp(0, columns - 1)[:, None, :]) * bins
    index = w.long().clamp(0, bins - 1)[:, :, None, None] + place
    weight = bin_weight[:, :, None, None] * (row_weight[:, None, :, None] * column_weight[:, None, :])
    return index.flatten(1), weight.flatten(1, 3)


GridSplat = module_of(grid_splat, _check_settings)
GridSlice = module_of(grid_slice, _check_settings)
