"""Display values and light: what an 8-bit picture holds, and radiance."""

from __future__ import annotations

import torch

from mcdenoise.data.exr import Image


def decode(pixels: Image) -> Image:
    """``(H, W, 3)`` linear light of sRGB display values (IEC 61966-2-1)."""
    from kornia.color import rgb_to_linear_rgb  # here because it takes its time to load, and few files need it

    result: Image = rgb_to_linear_rgb(_planes(pixels))[0].permute(1, 2, 0).numpy()
    return result


def encode(pixels: Image) -> Image:
    """``(H, W, 3)`` sRGB display values of linear light; brighter than white is white."""
    from kornia.color import linear_rgb_to_rgb

    result: Image = linear_rgb_to_rgb(_planes(pixels).clamp(0, 1))[0].permute(1, 2, 0).numpy()
    return result


def _planes(pixels: Image) -> torch.Tensor:
    return torch.from_numpy(pixels).permute(2, 0, 1)[None]
