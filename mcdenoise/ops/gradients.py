"""Measure how much the light has changed since the frame before, and which fraction of the history to discard."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.ops._check import check_least, check_shapes
from mcdenoise.ops._edges import SIGMA_N, SIGMA_Z, bounded_quotient, check_sigmas, edge_average
from mcdenoise.ops._module import module_of
from mcdenoise.ops._numbers import unit_of
from mcdenoise.ops._op import made_of
from mcdenoise.ops._window import accumulator_dtype, corner, up_to_multiple

STRATUM, LEVELS = 3, 5
# Standard errors up to which a change is taken for noise.
THRESHOLD = 2.0
# Luminance that counts as black, as a fraction of the largest one of an image; and the largest variance, as a multiple
# of the square of that one. No change is seen through so much noise, and its sums are finite.
_BLACK, _NOISIEST = 1e-15, 1e30


@made_of(edge_average)
def temporal_gradient(
    current: Tensor,
    previous: Tensor,
    weight: Tensor | None = None,
    variance: Tensor | None = None,
    normal: Tensor | None = None,
    depth: Tensor | None = None,
    *,
    stratum: int = STRATUM,
    levels: int = LEVELS,
    threshold: float = THRESHOLD,
    sigma_z: float = SIGMA_Z,
    sigma_n: float = SIGMA_N,
) -> Tensor:
    """The normalised change of luminance from frame to frame, over strata of pixels and their neighbourhood.

    Per stratum of ``stratum x stratum`` pixels, with the weights ``w`` of the pixels that are compared, the change
    ``D = sum w (current - previous)``, its normaliser ``M = sum w max(current, previous)``, and the noise of the change
    ``V = sum w^2 variance``. These images of strata are filtered ``levels`` times over 3x3 taps that lie 1, 2, 4, ...
    strata apart: ``D`` and ``M`` become ``sum e x / sum e`` over the taps inside the image, and ``V`` becomes
    ``sum e^2 V / (sum e)^2``, with ``e = w_z w_n`` of :func:`mcdenoise.ops.atrous` for the middle pixels of the strata.
    Of the filtered images,

    ``out = sqrt(max(0, (D^2 - threshold^2 V) / M^2))``, at most 1, and 0 where ``M`` is no more than 1e-15 of the
    image's largest luminance,

    which is ``min(1, |D| / M)`` where there is no noise. Noise adds ``V`` to ``D^2`` on average; a change of at most
    ``threshold`` standard errors counts as noise altogether. The weight of the current frame in its history is then
    ``(1 - out) alpha + out``.

    Args:
        current: ``(B, 1, H, W)`` luminance now, at least 0, finite: of the samples of the frame before, shaded once
            more with their random numbers; or else of this frame.
        previous: ``(B, 1, H, W)`` luminance of the same samples, or at the same places, in the frame before, likewise.
        weight: ``(B, 1, H, W)`` at least 0, in any unit, how much of a pixel is compared: 0 where there is nothing to
            compare it with, and 1 for the one sample of a stratum that was shaded once more; by default 1 everywhere.
        variance: ``(B, 1, H, W)`` of ``current - previous`` where nothing changes, 0 to 1e34; by default 0, which is
            right for samples with the same random numbers.
        normal: ``(B, 3, H, W)`` unit normals, 0 where nothing was hit; without them ``w_n = 1``.
        depth: ``(B, 1, H, W)`` distance, any unit, 0 to 1e35, ``inf`` where nothing was hit; without it ``w_z = 1``.
        stratum: side of a stratum in pixels, at least 1; those at the right and lower border may be smaller.
        levels: how often to filter, at least 0.
        threshold: see above, at least 0.
        sigma_z: see :func:`mcdenoise.ops.atrous`.
        sigma_n: likewise.

    Returns:
        ``(B, 1, H, W)`` in [0, 1], the same for all pixels of a stratum, in the dtype of ``current``: 0 where nothing
        has changed, 1 where light went on or off. Half precision is computed in float32.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: a shape or a setting does not fit.

    Differentiable in all images, to any order, where ``current`` and ``previous`` differ, no depths within reach are
    equal, and the result is neither 0 nor 1.

    Source: Schied et al. 2018 (A-SVGF); the noise of the change is ours.

    Example:
        >>> lit = torch.rand(1, 1, 9, 9, generator=torch.Generator().manual_seed(0))
        >>> temporal_gradient(lit, lit).unique().tolist(), temporal_gradient(0 * lit, lit).unique().tolist()
        ([0.0], [1.0])
    """
    check_shapes(
        current=(current, "B 1 H W"),
        previous=(previous, "B 1 H W"),
        weight=(weight, "[B 1 H W]"),
        variance=(variance, "[B 1 H W]"),
        normal=(normal, "[B 3 H W]"),
        depth=(depth, "[B 1 H W]"),
    )
    _check_settings(stratum, levels, threshold, sigma_z, sigma_n)
    dtype = accumulator_dtype(current.dtype)
    now, before = current.to(dtype), previous.to(dtype)
    # In units in which the largest luminance and weight are between 1 and 2, so that no square leaves the range.
    largest = torch.maximum(now.detach(), before.detach()).abs().amax((1, 2, 3), keepdim=True)
    unit = unit_of(largest)
    now, before = now / unit, before / unit
    compared = torch.ones_like(now) if weight is None else weight.to(dtype)
    compared = compared / unit_of(compared.detach().amax((1, 2, 3), keepdim=True))
    noise = torch.zeros_like(now)
    if variance is not None:
        noise = compared.square() * (variance.to(dtype) / unit / unit).clamp_max(_NOISIEST)
    change = torch.cat([compared * (now - before), compared * torch.maximum(now, before)], 1)
    # Means in place of sums, over as many pixels beyond the border as inside.
    change = F.avg_pool2d(up_to_multiple(change, stratum), stratum)
    noise = F.avg_pool2d(up_to_multiple(noise, stratum), stratum) / stratum**2
    normal, depth = (None if image is None else _middle(image, stratum) for image in (normal, depth))
    for level in range(levels):
        change, noise = edge_average(
            *(change, noise, normal, depth), kernel=(1.0, 1.0, 1.0), step=1 << level, sigma_z=sigma_z, sigma_n=sigma_n
        )
    # ``D`` and ``M``. So little light counts as none.
    difference, size = change.split(1, 1)
    some = size > _BLACK * (largest / unit)
    size = torch.where(some, size, 1)
    error = bounded_quotient(threshold * torch.sqrt(torch.where(noise > 0, noise, 1)), size)
    excess = (difference / size).square() - torch.where(noise > 0, error.square(), 0)
    found = some & (excess > 0)
    gradient = torch.where(found, torch.sqrt(torch.where(found, excess, 1)).clamp_max(1), 0)
    result = F.interpolate(gradient, scale_factor=stratum, mode="nearest")
    return corner(result, current.shape[-2], current.shape[-1]).to(current.dtype)


def _check_settings(stratum: int, levels: int, threshold: float, sigma_z: float, sigma_n: float) -> None:
    check_least(1, stratum=stratum)
    check_least(0, levels=levels, threshold=threshold)
    check_sigmas(sigma_z, sigma_n)


TemporalGradient = module_of(temporal_gradient, _check_settings)


def _middle(image: Tensor, stratum: int) -> Tensor:
    """The middle pixel of every stratum, or the last one that it has."""
    for dim in (-2, -1):
        size = image.shape[dim]
        place = torch.arange(stratum // 2, size + stratum // 2, stratum, device=image.device)
        image = image.index_select(dim, place.clamp_max(size - 1))
    return image
