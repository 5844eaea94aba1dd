"""Averages over windows that stop at edges: a tap counts as far as it belongs to the same surface as the pixel."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.ops._constants import DEPTH_EPSILON, HIGHEST_QUOTIENT, LEAST_DEPTH
from mcdenoise.ops._op import op
from mcdenoise.ops._window import offsets, pad, shifted

SIGMA_Z, SIGMA_N = 1.0, 128.0


def check_sigmas(sigma_z: float, sigma_n: float, sigma_l: float = 1.0) -> None:
    """``ValueError`` for settings out of their range."""
    for name, sigma in (("sigma_z", sigma_z), ("sigma_l", sigma_l)):
        if not 0 < sigma < math.inf:
            raise ValueError(f"{name}: expected a positive number, found {sigma}")
    if not 1 <= sigma_n < math.inf:
        raise ValueError(f"sigma_n: expected at least 1, found {sigma_n}")


@op("numba")
def edge_average(
    image: Tensor,
    noise: Tensor,
    normal: Tensor | None,
    depth: Tensor | None,
    bright: Tensor | None = None,
    deviation: Tensor | None = None,
    *,
    kernel: Sequence[float],
    step: int,
    sigma_z: float,
    sigma_n: float,
) -> tuple[Tensor, Tensor]:
    """The mean of an image over a window, with the weights of :func:`mcdenoise.ops.atrous`, and its variance.

    Args:
        image: ``(B, C, H, W)``, at least float32, whose dtype is that of the sums and of both results.
        noise: ``(B, N, H, W)`` variances; none, of no channels, where they are not asked for.
        normal: ``(B, 3, H, W)``; without it ``w_n = 1``.
        depth: ``(B, 1, H, W)``; without it ``w_z = 1``.
        bright: ``(B, 1, H, W)`` luminance; without it ``w_l = 1``.
        deviation: ``(B, 1, H, W)`` by how much luminance may differ, above 0.
        kernel: weights of the taps along one axis, an odd number of them.
        step: pixels between taps.
        sigma_z: tolerance of depths.
        sigma_n: exponent of the cosine.

    Returns:
        ``sum a image / sum a`` and ``sum a^2 noise / (sum a)^2`` over the taps inside the image, with the products
        ``a`` of the kernel and of the edge-stopping weights.
    """
    normal, depth = (None if each is None else each.to(image.dtype) for each in (normal, depth))
    height, width = image.shape[-2:]
    radius = len(kernel) // 2 * step
    # What a tap is compared by, and its weight from that and its offset.
    guides: list[tuple[Tensor, Callable[[Tensor, int, int], Tensor]]] = []
    if depth is not None:
        hit = torch.isfinite(depth)
        z = torch.where(hit, depth, 0)
        guides.append((torch.cat([z, hit.to(z.dtype)], 1), _of_depth(z, hit, sigma_z)))
    if normal is not None:
        guides.append((normal, _of_normal(normal, sigma_n)))
    if bright is not None and deviation is not None:
        guides.append((bright, _of_luminance(bright, deviation)))
    images = [image, noise, torch.ones_like(image[:, :1]), *(guide for guide, _ in guides)]
    channels, padded = [each.shape[1] for each in images], pad(torch.cat(images, 1), radius, "zeros")
    total, image_sum, noise_sum = torch.zeros_like(image[:, :1]), torch.zeros_like(image), torch.zeros_like(noise)
    for tap, dy, dx in offsets(len(kernel)):
        row, column = divmod(tap, len(kernel))
        moved = shifted(padded, radius, dy * step, dx * step, height, width)
        seen, variance, inside, *others = moved.split(channels, 1)
        weight = kernel[row] * kernel[column] * inside
        for (_, factor), other in zip(guides, others, strict=True):
            weight = weight * factor(other, dy * step, dx * step)
        total = total + weight
        image_sum = image_sum + weight * seen
        noise_sum = noise_sum + weight.square() * variance
    return image_sum / total, noise_sum / total.square()


def bounded_quotient(difference: Tensor, tolerance: Tensor) -> Tensor:
    """``difference / tolerance`` of two that are not negative, no more than 1e4."""
    return difference / torch.maximum(tolerance, difference.detach() / HIGHEST_QUOTIENT)


def _of_normal(normal: Tensor, sigma: float) -> Callable[[Tensor, int, int], Tensor]:
    def weight(other: Tensor, dy: int, dx: int) -> Tensor:
        cosine = 1 - (other - normal).square().sum(1, keepdim=True) / 2
        unlike = cosine <= 0
        # The second derivative of a power of 0 may be infinite.
        return torch.where(unlike, 0, torch.where(unlike, 1, cosine) ** sigma)  # Eq. 4

    return weight


def _of_luminance(bright: Tensor, deviation: Tensor) -> Callable[[Tensor, int, int], Tensor]:
    return lambda other, dy, dx: torch.exp(-bounded_quotient((other - bright).abs(), deviation))  # Eq. 5


def _of_depth(z: Tensor, hit: Tensor, sigma: float) -> Callable[[Tensor, int, int], Tensor]:
    slope_x, slope_y = _slope(z, hit, -1), _slope(z, hit, -2)
    least = DEPTH_EPSILON * z + LEAST_DEPTH

    def weight(other: Tensor, dy: int, dx: int) -> Tensor:
        there, other_hit = other.split(1, 1)
        tolerance = sigma * (slope_x * dx + slope_y * dy).abs() + least
        near = torch.exp(-bounded_quotient((there - z).abs(), tolerance))
        return torch.where(other_hit == hit, near, 0)  # Eq. 3

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
