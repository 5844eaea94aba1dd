"""Squared differences of a guide over a window, and their derivative."""

from __future__ import annotations

import torch
from torch import Tensor

from mcdenoise.ops._window import Border, kernel_size_of, offsets, pad, shifted, unpad


def squared_distance(padded: Tensor, radius: int, dy: int, dx: int, height: int, width: int) -> Tensor:
    """``(B, 1, H, W)``: over the channels, of each pixel and the one at that offset."""
    centre = shifted(padded, radius, 0, 0, height, width)
    difference = shifted(padded, radius, dy, dx, height, width) - centre
    return difference.square().sum(1, keepdim=True)


def guide_gradient(gradient: Tensor, guide: Tensor, scale: Tensor, border: Border) -> Tensor:
    """The derivative in one guide, times the gradient of each tap's exponent, in the dtype of ``guide``."""
    radius = kernel_size_of(gradient.shape[1], "kernel") // 2
    padded = pad(guide.to(gradient.dtype), radius, border)
    return unpad(padded_gradient(gradient, padded, scale.to(gradient.dtype), radius), radius, border).to(guide.dtype)


def padded_gradient(gradient: Tensor, padded: Tensor, scale: Tensor, radius: int) -> Tensor:
    """Each tap pulls the neighbour one way and the centre the other."""
    height, width = gradient.shape[-2:]
    # Under vmap it must have the axis of whichever of the three has one.
    total = torch.zeros_like(padded) + gradient.new_zeros(()) + scale.new_zeros(())
    centre = shifted(padded, radius, 0, 0, height, width)
    centre_total = torch.zeros_like(centre)
    for tap, dy, dx in offsets(2 * radius + 1):
        difference = shifted(padded, radius, dy, dx, height, width) - centre
        pull = (-2 * gradient[:, tap : tap + 1] * scale) * difference
        shifted(total, radius, dy, dx, height, width).add_(pull)
        centre_total = centre_total - pull
    shifted(total, radius, 0, 0, height, width).add_(centre_total)
    return total
