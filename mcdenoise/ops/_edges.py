"""Edge-stopping functions of what a pixel sees: how much of a tap belongs to the same surface."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.ops._window import pad, shifted

SIGMA_Z, SIGMA_N = 1.0, 128.0
# The paper's epsilon, which it leaves open: of the depth, as much as half-float depths are known to.
DEPTH_EPSILON = 1e-3
# What keeps quotients and their derivatives finite, where `exp` of them is zero in any precision.
_LEAST_DEPTH, _HIGHEST = 1e-30, 1e4


def layouts(normal: Tensor | None, depth: Tensor | None) -> dict[str, tuple[Tensor, str]]:
    """What :func:`mcdenoise.ops._check.check_shapes` has to know of the two."""
    given = {"normal": (normal, "B 3 H W"), "depth": (depth, "B 1 H W")}
    return {name: (image, layout) for name, (image, layout) in given.items() if image is not None}


def check_sigmas(sigma_z: float, sigma_n: float, sigma_l: float = 1.0) -> None:
    """``ValueError`` for settings out of their range."""
    for name, sigma in (("sigma_z", sigma_z), ("sigma_l", sigma_l)):
        if not 0 < sigma < math.inf:
            raise ValueError(f"{name}: expected a positive number, found {sigma}")
    if not 1 <= sigma_n < math.inf:
        raise ValueError(f"sigma_n: expected at least 1, found {sigma_n}")


def edge_stopping(
    normal: Tensor | None, depth: Tensor | None, dtype: torch.dtype, radius: int, sigma_z: float, sigma_n: float
) -> Callable[[int, int], Tensor | float]:
    """The function of an offset ``(dy, dx)`` that gives ``w_z w_n``, see :func:`mcdenoise.ops.atrous`.

    Args:
        normal: ``(B, 3, H, W)`` or ``None``.
        depth: ``(B, 1, H, W)`` or ``None``.
        dtype: to compute in.
        radius: of the farthest tap in pixels.
        sigma_z: tolerance of depths.
        sigma_n: exponent of the cosine.

    Returns:
        ``(B, 1, H, W)`` for each offset, whatever lies outside of the image; 1 without normals and depths.
    """
    factors: list[Callable[[int, int], Tensor]] = []
    if depth is not None:
        factors.append(_of_depth(depth.to(dtype), radius, sigma_z))
    if normal is not None:
        factors.append(_of_normal(normal.to(dtype), radius, sigma_n))

    def weight(dy: int, dx: int) -> Tensor | float:
        product: Tensor | float = 1.0
        for factor in factors:
            product = product * factor(dy, dx)
        return product

    return weight


def bounded_quotient(difference: Tensor, tolerance: Tensor) -> Tensor:
    """``difference / tolerance`` of two that are not negative, no more than 1e4."""
    return difference / torch.maximum(tolerance, difference.detach() / _HIGHEST)


def _of_normal(normal: Tensor, radius: int, sigma: float) -> Callable[[int, int], Tensor]:
    height, width = normal.shape[-2:]
    padded = pad(normal, radius, "zeros")

    def weight(dy: int, dx: int) -> Tensor:
        squared = (shifted(padded, radius, dy, dx, height, width) - normal).square().sum(1, keepdim=True)
        return (1 - squared / 2).clamp_min(0) ** sigma  # Eq. 4

    return weight


def _of_depth(depth: Tensor, radius: int, sigma: float) -> Callable[[int, int], Tensor]:
    height, width = depth.shape[-2:]
    hit = torch.isfinite(depth)
    z = torch.where(hit, depth, 0)
    slope_x, slope_y = _slope(z, hit, -1), _slope(z, hit, -2)
    least = DEPTH_EPSILON * z + _LEAST_DEPTH
    padded, padded_hit = pad(z, radius, "zeros"), F.pad(hit, (radius,) * 4)

    def weight(dy: int, dx: int) -> Tensor:
        difference = (shifted(padded, radius, dy, dx, height, width) - z).abs()
        tolerance = sigma * (slope_x * dx + slope_y * dy).abs() + least
        alike = shifted(padded_hit, radius, dy, dx, height, width) == hit
        return torch.where(alike, torch.exp(-bounded_quotient(difference, tolerance)), 0)  # Eq. 3

    return weight


def _slope(z: Tensor, hit: Tensor, dim: int) -> Tensor:
    """The smaller of the differences to the next and from the previous pixel, 0 where both are missing."""
    count = z.shape[dim] - 1
    both = hit.narrow(dim, 1, count) & hit.narrow(dim, 0, count)
    steps = torch.where(both, z.diff(dim=dim), torch.inf)
    before, after = ((1, 0), (0, 1)) if dim == -1 else ((0, 0, 1, 0), (0, 0, 0, 1))
    backward, forward = F.pad(steps, before, value=torch.inf), F.pad(steps, after, value=torch.inf)
    smaller = torch.where(forward.abs() < backward.abs(), forward, backward)
    return torch.where(smaller.isfinite(), smaller, 0)
