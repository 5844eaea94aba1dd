"""Conversion between sRGB display values and linear light."""

from __future__ import annotations

import torch

from mcdenoise.data.exr import Image


def decode(pixels: Image) -> Image:
    """Convert ``(H, W, 3)`` sRGB display values to linear light (IEC 61966-2-1)."""
    from kornia.color import rgb_to_linear_rgb  # imported here because it is slow to load

    result: Image = rgb_to_linear_rgb(_planes(pixels))[0].permute(1, 2, 0).numpy()
    return result


def encode(pixels: Image) -> Image:
    """Convert ``(H, W, 3)`` linear light to sRGB display values; values above white are clamped."""
    from kornia.color import linear_rgb_to_rgb

    result: Image = linear_rgb_to_rgb(_planes(pixels).clamp(0, 1))[0].permute(1, 2, 0).numpy()
    return result


def _planes(pixels: Image) -> torch.Tensor:
    return torch.from_numpy(pixels).permute(2, 0, 1)[None]
