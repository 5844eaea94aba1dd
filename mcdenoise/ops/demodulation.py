"""Albedo demodulation: divide the texture out before filtering, multiply it back after."""

from __future__ import annotations

import torch
from torch import Tensor

from mcdenoise.ops._check import check_positive, check_shapes
from mcdenoise.ops._constants import FLOOR, NO_ALBEDO
from mcdenoise.ops._module import module_of
from mcdenoise.ops._window import accumulator_dtype


def demodulate(color: Tensor, albedo: Tensor, *, floor: float = FLOOR) -> Tensor:
    """Divide radiance by albedo, which leaves the (smooth) incident light where the surface is diffuse.

    ``out = color / m`` with the modulation ``m = max(albedo, floor)``, and ``m = 1`` where no channel of the pixel's
    albedo reaches 1e-4: emitters, mirrors, glass and background have no texture to divide out and pass unchanged.
    :func:`remodulate` multiplies with the same ``m`` and is the exact inverse everywhere, up to rounding.

    Args:
        color: ``(B, C, H, W)`` radiance, scene-linear, unclamped.
        albedo: ``(B, C, H, W)`` diffuse reflectance, usually in [0, 1].
        floor: smallest albedo that is divided by, above 0; no value grows by more than ``1 / floor``.

    Returns:
        ``(B, C, H, W)`` demodulated radiance, to rounding at any radiance and albedo whose quotient the dtype holds.
        Half precision is computed in float32.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: shapes disagree or ``floor`` is not positive.

    Differentiable in ``color`` and ``albedo``, to any order; where ``albedo`` is below ``floor`` its derivative is 0.

    Source: Koskela et al. 2019, "Blockwise multi-order feature regression for real-time path-tracing
    reconstruction", Sec. 3; the paper's Sec. 4.1.

    Example:
        >>> color = torch.tensor([0.2, 0.1, 5.0]).reshape(1, 3, 1, 1)
        >>> demodulate(color, torch.tensor([0.5, 0.5, 0.0]).reshape(1, 3, 1, 1)).flatten().tolist()
        [0.4000000059604645, 0.20000000298023224, 125.0]
        >>> demodulate(color, torch.zeros(1, 3, 1, 1)).equal(color)
        True
    """
    check_shapes(color=(color, "B C H W"), albedo=(albedo, "B C H W"))
    return (color.to(accumulator_dtype(color.dtype)) / modulation(albedo, floor)).to(color.dtype)


def remodulate(image: Tensor, albedo: Tensor, *, floor: float = FLOOR) -> Tensor:
    """Multiply albedo back: the inverse of :func:`demodulate` with the same ``albedo`` and ``floor``.

    ``out = image * m``, ``m`` as in :func:`demodulate`.

    Args:
        image: ``(B, C, H, W)`` demodulated radiance.
        albedo: ``(B, C, H, W)`` diffuse reflectance, usually in [0, 1].
        floor: as given to :func:`demodulate`.

    Returns:
        ``(B, C, H, W)`` radiance, to rounding as :func:`demodulate`.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: shapes disagree or ``floor`` is not positive.

    Differentiable in ``image`` and ``albedo``, to any order; where ``albedo`` is below ``floor`` its derivative is 0.

    Source: as :func:`demodulate`.

    Example:
        >>> color, albedo = torch.rand(1, 3, 4, 4), torch.rand(1, 3, 4, 4)
        >>> torch.allclose(remodulate(demodulate(color, albedo), albedo), color)
        True
    """
    check_shapes(image=(image, "B C H W"), albedo=(albedo, "B C H W"))
    return (image.to(accumulator_dtype(image.dtype)) * modulation(albedo, floor)).to(image.dtype)


Demodulate = module_of(demodulate)
Remodulate = module_of(remodulate)


def modulation(albedo: Tensor, floor: float = FLOOR) -> Tensor:
    """The modulation ``m`` by which :func:`demodulate` divides, ``(B, C, H, W)``."""
    check_positive(floor=floor)
    albedo = albedo.to(accumulator_dtype(albedo.dtype))
    textured = (albedo >= NO_ALBEDO).any(1, keepdim=True)
    return torch.where(textured, albedo.clamp_min(floor), 1)
