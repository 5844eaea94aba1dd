"""Fit every block of an image by its features with least squares."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mcdenoise.ops._check import check_least, check_shapes
from mcdenoise.ops._module import module_of
from mcdenoise.ops._window import mirrored_places, parts_of

BLOCK = 32
# The fit changes the part of the image that the features explain by this fraction: less than float32 rounds.
RIDGE = 1e-8
# Times sqrt(RIDGE), the deviation that counts as none: 1e-7 of a feature, as much as float32 rounds.
_FLAT = 1e-3
# Far above the rounding of float64, since a square is divided by it.
_NOTHING = 1e-9


def block_regression(
    image: Tensor,
    features: Tensor,
    *,
    block: int = BLOCK,
    offset: tuple[int, int] = (0, 0),
    squares: int = 0,
    ridge: float = RIDGE,
) -> Tensor:
    """Replace every block of an image by the linear combination of its features that is nearest to it.

    In each block of ``n = block^2`` pixels, with the means ``m`` over it of the image ``y`` and ``m_j`` of its features
    ``x_j``,

    ``out[p] = m + sum_j w_j z_j[p]`` with the weights ``w`` of
    ``min sum_p (y[p] - m - sum_j w_j z_j[p])^2 + n ridge sum_j w_j^2`` for each channel, and
    ``z_j = (x_j - m_j) / sqrt(variance(x_j) + 1e-6 mean(x_j^2))``.

    The last ``squares`` features enter once more as ``z_j u_j`` minus its mean, where ``u_j`` is ``z_j`` with 1e-18 in
    place of 1e-6: the square of the feature, as far as it varies. So the unit and the origin of a feature do not
    matter, the mean of every block stays, and an image that is linear in the features is returned, except that its
    deviations from the mean shrink by the fraction ``ridge``. Features that are combinations of one another, and
    features without any variation, are no special case: the ridge chooses among their weights, and the result hardly
    depends on it. A feature that deviates by less than ``1e-3 sqrt(ridge)`` of its size counts as constant.

    Blocks at the borders extend beyond the image, where its pixels are mirrored with the last one repeated, for any
    size of the image.

    Args:
        image: ``(B, C, H, W)`` anything, finite.
        features: ``(B, F, H, W)`` of the same pixels without noise, each in any unit, finite; a constant one need not
            be among them.
        block: side of a block in pixels, at least 2.
        offset: how many rows and columns before the image the first block begins, each from 0 to ``block - 1``.
        squares: how many features, the last ones, enter with their squares, from 0 to ``F``.
        ridge: see above, above 0; the condition of the solved system is at most ``sqrt(1 / ridge)`` times the number of
            features, so that float64 keeps eleven digits of it by default.

    Returns:
        ``(B, C, H, W)`` in the dtype of ``image``. Computed in float64, whatever the dtype, by Householder QR.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: a shape or a setting does not fit.

    Differentiable in ``image``, to any order, and in ``features``, where none is 0 throughout a block.

    Source: Koskela et al. 2019 (BMFR). There, uniformly distributed noise of +-0.01, drawn for every frame, makes the
    features independent of one another; on average that adds ``n 1e-4 / 3`` to the diagonal of the normal equations.
    Here it is a ridge, so that the same frame gives the same image.

    Example:
        >>> features = torch.rand(1, 2, 40, 50, generator=torch.Generator().manual_seed(0))
        >>> image = 0.5 + 2 * features[:, :1] - 3 * features[:, 1:]
        >>> bool((block_regression(image, features) - image).abs().max() < 1e-6)
        True
    """
    sizes = check_shapes(image=(image, "B C H W"), features=(features, "B F H W"))
    _check_settings(block, offset, squares, ridge)
    count = sizes["F"]
    if count < max(squares, 1):
        raise ValueError(f"features: expected at least {max(squares, 1)} channels, found {count}")
    if image.numel() == 0:
        return image
    rows, columns = (
        # As many whole blocks as cover the axis.
        mirrored_places(torch.arange(-start, parts_of(size + start, block) * block - start, device=image.device), size)
        for size, start in zip((sizes["H"], sizes["W"]), offset, strict=True)
    )
    both = torch.cat([features.to(torch.float64), image.to(torch.float64)], 1)
    whole = both.index_select(2, rows).index_select(3, columns)
    grid = (len(rows) // block, len(columns) // block)
    x, y = _to_blocks(whole, block, grid).split([count, sizes["C"]], 2)
    z = _standardized(x, _FLAT)
    if squares:
        last = count - squares
        curved = z[..., last:] * _standardized(x[..., last:], _NOTHING)
        z = torch.cat([z, curved - curved.mean(1, keepdim=True)], 2)
    number = z.shape[2]
    penalty = math.sqrt(block * block * ridge) * torch.eye(number, dtype=z.dtype, device=z.device)
    penalties = penalty + torch.zeros_like(z[:, :1, :1])
    # With [z; penalty] = Q R, the combination of its columns nearest to [y; 0] is Q Q^T [y; 0].
    orthogonal = torch.linalg.qr(torch.cat([z, penalties], 1)).Q[:, : block * block]
    mean = y.mean(1, keepdim=True)
    fitted = mean + orthogonal @ (orthogonal.mT @ (y - mean))
    result = _from_blocks(fitted, block, grid, sizes["B"])
    top, left = offset
    return result.narrow(2, top, sizes["H"]).narrow(3, left, sizes["W"]).to(image.dtype)


def _check_settings(block: int, offset: tuple[int, int], squares: int, ridge: float) -> None:
    check_least(2, block=block)
    if len(offset) != 2 or not all(0 <= start < block for start in offset):
        raise ValueError(f"offset: expected two numbers from 0 to {block - 1}, found {offset}")
    check_least(0, squares=squares)
    if not 0 < ridge < math.inf:
        raise ValueError(f"ridge: expected a positive number, found {ridge}")


BlockRegression = module_of(block_regression, _check_settings)


def _to_blocks(image: Tensor, block: int, grid: tuple[int, int]) -> Tensor:
    """``(B * blocks, block^2, C)`` of ``(B, C, H, W)``."""
    batch, channels = image.shape[:2]
    parts = image.reshape(batch, channels, grid[0], block, grid[1], block)
    return parts.permute(0, 2, 4, 3, 5, 1).reshape(batch * grid[0] * grid[1], block * block, channels)


def _from_blocks(blocks: Tensor, block: int, grid: tuple[int, int], batch: int) -> Tensor:
    """The inverse of :func:`_to_blocks`."""
    channels = blocks.shape[2]
    parts = blocks.reshape(batch, grid[0], grid[1], block, block, channels)
    return parts.permute(0, 5, 1, 3, 2, 4).reshape(batch, channels, grid[0] * block, grid[1] * block)


def _standardized(x: Tensor, least: float) -> Tensor:
    """``z_j`` or ``u_j`` of the contract; 0 for a feature that is 0 throughout a block."""
    # The mean of large numbers is rounded more than their differences are.
    apart = x - x[:, :1].detach()
    centred = apart - apart.mean(1, keepdim=True)
    square = x.square().mean(1, keepdim=True)
    size = centred.square().mean(1, keepdim=True) + least**2 * square
    return centred / torch.sqrt(torch.where(square > 0, size, 1))
