"""Differences of neighbouring pixels, which tell the noise of an image, see :func:`mcdenoise.noise.noise_of`."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
import torch.nn.functional as F
from torch import Tensor

# Only the pixels of rows and columns at this distance are read.
EVERY = 8
# Smallest albedo to divide by, largest radiance, and smallest sum of pixels that differences are relative to.
DARKEST_ALBEDO, BRIGHTEST, LEAST_SUM = 0.02, 1e16, 1e-9
# Where a feature changes by EVEN_FEATURE from pixel to pixel, differences may be those of the scene: their weight is
# UNEVEN. Smaller differences than ROUNDED are rounding errors; edges and fireflies, which are larger than
# LARGE_DIFFERENCE, should not outweigh the rest.
EVEN_FEATURE, UNEVEN, ROUNDED, LARGE_DIFFERENCE = 0.02, 0.01, 1e-6, 0.1
# Fourth differences of independent noise of variance 1 have the variance 70, second differences 6.
FOURTH = math.sqrt(70 / 6)


def noise_sums(color: Tensor, albedo: Tensor | None, normal: Tensor | None, least: float) -> Tensor:
    """Sums over the pixels of every eighth row, and of every eighth column.

    Args:
        color: ``(B, 3, H, W)`` noisy radiance; invalid values count as 0.
        albedo: ``(B, 3, H, W)``; ``None`` if there is none.
        normal: likewise, in any encoding.
        least: pixels whose difference ``wide`` is larger count as noisy.

    Returns:
        ``(B, 2, 5)`` of rows and of columns, at least in float32: the weights ``w`` of the pixels, ``w wide``, the
        weights of noisy pixels, ``w near / (near + 0.1)``, and the same of ``wide``.
    """
    rows = [None if each is None else each[..., ::EVERY, :] for each in (color, albedo, normal)]
    columns = [None if each is None else each[..., ::EVERY].mT for each in (color, albedo, normal)]
    return torch.stack([_sums(each, least) for each in (rows, columns)], 1)


def _sums(images: Iterable[Tensor | None], least: float) -> Tensor:
    color, albedo, normal = (None if each is None else _valid(each) for each in images)
    assert color is not None
    light = color.clamp_min(0)
    if albedo is not None:
        light = light / albedo.clamp_min(DARKEST_ALBEDO)
    a, b, c, d, e = _padded(light.mean(1, keepdim=True)).unfold(-1, 5, 1).unbind(-1)
    mean = (a + b + 2 * c + d + e).clamp_min(LEAST_SUM)
    near = (a - 4 * b + 6 * c - 4 * d + e).abs() / (FOURTH * mean)
    wide = (a - 2 * c + e).abs() / mean
    weight = torch.ones_like(mean)
    if features := [each for each in (albedo, normal) if each is not None]:
        steps = _padded(torch.cat(features, 1)).diff(dim=-1).abs().amax(1, keepdim=True)
        weight = (1 - steps.unfold(-1, 4, 1).amax(-1) / EVEN_FEATURE).clamp_min(UNEVEN)
    weight = weight * (near + wide > ROUNDED)
    counted = (torch.ones_like(wide), wide, wide > least, *(each / (each + LARGE_DIFFERENCE) for each in (near, wide)))
    return torch.stack([(weight * each).sum((1, 2, 3)) for each in counted], -1)


def _valid(image: Tensor) -> Tensor:
    dtype = torch.promote_types(image.dtype, torch.float32)
    return image.to(dtype).nan_to_num(0.0).clamp(-BRIGHTEST, BRIGHTEST)


def _padded(rows: Tensor) -> Tensor:
    """``(B, C, H, W)`` with two more pixels at both ends of each row."""
    return F.pad(rows, (2, 2, 0, 0), mode="replicate")
