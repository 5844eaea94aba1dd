"""One level of the edge-avoiding a-trous wavelet transform, with the edge-stopping functions of SVGF."""

from __future__ import annotations

import torch
from torch import Tensor

from mcdenoise.ops._check import check_least, check_shapes
from mcdenoise.ops._edges import SIGMA_N, SIGMA_Z, check_sigmas, edge_average
from mcdenoise.ops._module import module_of
from mcdenoise.ops._op import made_of
from mcdenoise.ops._window import accumulator_dtype, pad
from mcdenoise.ops.moments import luminance

SIGMA_L = 4.0
# h of Eq. 1, along one axis.
_KERNEL = (1 / 16, 1 / 4, 3 / 8, 1 / 4, 1 / 16)
# The smallest deviation, the epsilon of Eq. 5, which the paper leaves open, and the scale in which it has a square in
# float32, as has the largest deviation: dim light is filtered as bright light is.
_LEAST_DEVIATION, _SCALE = 2.0**-69, 64


@made_of(edge_average)
def atrous(
    light: Tensor,
    variance: Tensor,
    normal: Tensor | None = None,
    depth: Tensor | None = None,
    *,
    step: int = 1,
    sigma_z: float = SIGMA_Z,
    sigma_n: float = SIGMA_N,
    sigma_l: float = SIGMA_L,
) -> tuple[Tensor, Tensor]:
    """Filter light by 5x5 taps that lie ``step`` pixels apart and stop at edges, and its variance along with it.

    With the kernel ``h = (1, 4, 6, 4, 1) / 16`` along each axis and the sums over the taps ``q`` inside the image,

    - ``out[p] = sum h w light[q] / sum h w`` (Eq. 1) and ``sum (h w)^2 variance[q] / (sum h w)^2`` (Eq. 2),
    - ``w = w_z w_n w_l``,
    - ``w_z = exp(-|z[p] - z[q]| / (sigma_z |slope[p] . (p - q)| + 0.001 z[p]))`` (Eq. 3),
    - ``w_n = max(0, n[p] . n[q])^sigma_n`` (Eq. 4), as ``max(0, 1 - |n[p] - n[q]|^2 / 2)^sigma_n``, which is the same
      for unit normals, and 1 for two pixels without one,
    - ``w_l = exp(-|l[p] - l[q]| / (sigma_l sqrt(g(variance)[p])))`` (Eq. 5), with the luminance ``l`` of
      :func:`mcdenoise.ops.luminance_moments` and the 3x3 Gaussian ``g``; a deviation is at least 2^-69.

    ``slope`` is the difference of the depths of two neighbouring pixels, on that side on which it is smaller: the other
    may lie beyond an edge. Pixels that hit nothing are alike in depth, and unlike all others.

    Args:
        light: ``(B, 3 + C, H, W)`` scene-linear radiance, usually demodulated, finite; and any further images, which
            are filtered with its weights.
        variance: ``(B, 1, H, W)`` of its luminance, 0 to 1e34, in its unit squared.
        normal: ``(B, 3, H, W)`` unit normals, 0 where nothing was hit; without them ``w_n = 1``.
        depth: ``(B, 1, H, W)`` distance, any unit, 0 to 1e35, ``inf`` where nothing was hit; without it ``w_z = 1``.
        step: pixels between taps, at least 1: 1, 2, 4, 8, 16 for the levels of the transform.
        sigma_z: tolerance of depths, above 0: how many times the slope they may differ.
        sigma_n: exponent of the cosine between normals, at least 1.
        sigma_l: tolerance of luminance, above 0, in standard deviations.

    Returns:
        ``(B, 3 + C, H, W)`` filtered light and ``(B, 1, H, W)`` variance of its luminance, each in its argument's
        dtype. Half precision is computed in float32. A mean of the input, whatever the weights: the pixel itself has
        the weight ``h`` at least.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: a shape or a setting does not fit.

    Differentiable in ``light``, ``variance``, ``normal`` and ``depth``, to any order, where no two luminances or depths
    within reach are equal and no two slopes of a pixel.

    Source: Schied et al. 2017 (SVGF), Secs. 4.3 and 4.4, Eqs. 1 to 5; the transform is that of Dammertz et al. 2010.

    Example:
        >>> light = torch.rand(1, 3, 8, 8, generator=torch.Generator().manual_seed(0))
        >>> filtered, variance = atrous(light, torch.full((1, 1, 8, 8), 0.1))
        >>> bool(filtered.var() < light.var() / 2), bool(variance.max() < 0.05)
        (True, True)
    """
    surface = {"normal": (normal, "[B 3 H W]"), "depth": (depth, "[B 1 H W]")}
    sizes = check_shapes(light=(light, "B C H W"), variance=(variance, "B 1 H W"), **surface)
    if sizes["C"] < 3:
        raise ValueError(f"light: expected at least 3 channels, found {sizes['C']}")
    _check_settings(step, sigma_z, sigma_n, sigma_l)
    dtype = accumulator_dtype(light.dtype)
    image, noise = light.to(dtype), variance.to(dtype)
    deviation = sigma_l / _SCALE * torch.sqrt(blurred(noise) * _SCALE**2 + (_LEAST_DEVIATION * _SCALE) ** 2)
    filtered, remaining = edge_average(
        *(image, noise, normal, depth, luminance(image[:, :3]), deviation),
        kernel=_KERNEL,
        step=step,
        sigma_z=sigma_z,
        sigma_n=sigma_n,
    )
    return filtered.to(light.dtype), remaining.to(variance.dtype)


def _check_settings(step: int, sigma_z: float, sigma_n: float, sigma_l: float) -> None:
    check_least(1, step=step)
    check_sigmas(sigma_z, sigma_n, sigma_l)


Atrous = module_of(atrous, _check_settings)


def blurred(variance: Tensor) -> Tensor:
    """``g`` of Eq. 5; the border is repeated."""
    image = pad(variance, 1, "replicate")
    for dim, size in ((-2, variance.shape[-2]), (-1, variance.shape[-1])):
        before, here, after = (image.narrow(dim, start, size) for start in range(3))
        image = here / 2 + (before + after) / 4
    return image
