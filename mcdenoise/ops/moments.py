"""Moments of luminance, and the variance that follows from them."""

from __future__ import annotations

import torch
from torch import Tensor

from mcdenoise.ops._check import check_kernel_size, check_shapes
from mcdenoise.ops._edges import SIGMA_N, SIGMA_Z, check_sigmas, edge_average
from mcdenoise.ops._module import module_of
from mcdenoise.ops._op import made_of
from mcdenoise.ops._window import accumulator_dtype

# Weights of linear RGB with the primaries of Rec. 709.
LUMINANCE = (0.2126, 0.7152, 0.0722)


def luminance_moments(light: Tensor) -> Tensor:
    """Luminance of each pixel, and its square: the first two raw moments of one sample.

    ``l = 0.2126 R + 0.7152 G + 0.0722 B``, ``out = (l, l^2)``. Accumulated over frames like the light itself
    (:func:`mcdenoise.ops.accumulate`), they give the variance (:func:`moments_variance`).

    Args:
        light: ``(B, 3, H, W)`` scene-linear radiance, linear Rec. 709 RGB.

    Returns:
        ``(B, 2, H, W)``, at least float32, since half precision cannot hold most squares; infinite where that cannot
        hold one either, from 1.8e19 on in float32.

    Raises:
        TypeError: the light is no floating-point tensor.
        ValueError: its shape does not fit.

    Differentiable in ``light``, to any order.

    Source: Schied et al. 2017 (SVGF), Sec. 4.2; luminance: ITU-R BT.709.

    Example:
        >>> luminance_moments(torch.full((1, 3, 1, 1), 2.0)).flatten().tolist()
        [2.0, 4.0]
    """
    check_shapes(light=(light, "B 3 H W"))
    bright = luminance(light.to(accumulator_dtype(light.dtype)))
    return torch.cat([bright, bright.square()], 1)


@made_of(edge_average)
def moments_variance(
    moments: Tensor,
    normal: Tensor | None = None,
    depth: Tensor | None = None,
    *,
    kernel_size: int = 1,
    sigma_z: float = SIGMA_Z,
    sigma_n: float = SIGMA_N,
) -> Tensor:
    """Variance of luminance from its first two moments, in time alone or over a window too.

    ``out = max(0, m2 - m1^2)`` with ``m = sum_q w moments[q] / sum_q w`` over the taps inside the image of a square
    window, and ``w = w_z w_n`` of :func:`mcdenoise.ops.atrous`. The moments of few frames hardly determine the noise;
    with those of the same surface around the pixel it is known better, but detail counts as noise, too.

    Args:
        moments: ``(B, 2, H, W)`` accumulated :func:`luminance_moments`, finite.
        normal: ``(B, 3, H, W)`` unit normals, 0 where nothing was hit; without them ``w_n = 1``.
        depth: ``(B, 1, H, W)`` distance, 0 to 1e35, ``inf`` where nothing was hit; without it ``w_z = 1``.
        kernel_size: side of the window in pixels, odd; 1 looks at the pixel alone, 7 is the paper's window.
        sigma_z: see :func:`mcdenoise.ops.atrous`.
        sigma_n: likewise.

    Returns:
        ``(B, 1, H, W)`` variance of one sample in the dtype of ``moments``, in the unit of luminance squared. Half
        precision is computed in float32. Where the noise is smaller than the mean by half of the dtype's digits, the
        difference of the two is rounding.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: a shape or a setting does not fit.

    Differentiable in ``moments``, ``normal`` and ``depth``, to any order, where the variance is not exactly 0 and no
    depths within reach are equal.

    Source: Schied et al. 2017 (SVGF), Sec. 4.2.

    Example:
        >>> moments_variance(torch.tensor([2.0, 4.5]).reshape(1, 2, 1, 1)).item()
        0.5
        >>> samples = luminance_moments(torch.randn(1, 1, 32, 32).expand(1, 3, 32, 32))
        >>> bool(abs(moments_variance(samples, kernel_size=31)[0, 0, 16, 16] - 1) < 0.25)
        True
    """
    check_shapes(moments=(moments, "B 2 H W"), normal=(normal, "[B 3 H W]"), depth=(depth, "[B 1 H W]"))
    _check_settings(kernel_size, sigma_z, sigma_n)
    mean, scale = moments.to(accumulator_dtype(moments.dtype)), 1.0
    if kernel_size > 1:
        # A power of two, which rounds nothing, so that no sum of representable moments overflows.
        scale = 2.0 ** -(kernel_size**2).bit_length()
        mean, _ = edge_average(
            *(mean * scale, mean[:, :0], normal, depth),
            kernel=[1.0] * kernel_size,
            step=1,
            sigma_z=sigma_z,
            sigma_n=sigma_n,
        )
    first, second = mean.split(1, 1)
    difference = second - first.square() / scale
    return (torch.where(difference > 0, difference, 0) / scale).to(moments.dtype)


def luminance(light: Tensor) -> Tensor:
    """``(B, 1, H, W)`` of ``(B, 3, H, W)``."""
    red, green, blue = (weight * channel for weight, channel in zip(LUMINANCE, light.split(1, 1), strict=True))
    result: Tensor = red + green + blue
    return result


def _check_settings(kernel_size: int, sigma_z: float, sigma_n: float) -> None:
    check_kernel_size(kernel_size)
    check_sigmas(sigma_z, sigma_n)


MomentsVariance = module_of(moments_variance, _check_settings)
