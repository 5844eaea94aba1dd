"""Conversion between display values and linear light."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from mcdenoise.data.exr import Image


def decode(pixels: Image, gamma: float = 0.0) -> Image:
    """Convert ``(..., C)`` display values to linear light.

    Args:
        pixels: one or three channels, or any number with a gamma.
        gamma: exponent of the display; 0 for the curve of sRGB (IEC 61966-2-1).
    """
    from kornia.color import rgb_to_linear_rgb  # imported here because it is slow to load

    return np.maximum(pixels, 0) ** np.float32(gamma) if gamma else _converted(rgb_to_linear_rgb, pixels)


def encode(pixels: Image, gamma: float = 0.0) -> Image:
    """Convert linear light to display values, the inverse of :func:`decode`; values above white are clamped."""
    from kornia.color import linear_rgb_to_rgb

    clamped = np.clip(pixels, 0, 1)
    return clamped ** np.float32(1 / gamma) if gamma else _converted(linear_rgb_to_rgb, clamped)


def _converted(convert: Callable[[Tensor], Tensor], pixels: Image) -> Image:
    # The curve is that of each number by itself, but the function wants three channels.
    planes = torch.from_numpy(np.ascontiguousarray(pixels, np.float32)).reshape(1, 1, -1).expand(1, 3, -1)[..., None]
    result: Image = convert(planes)[0, 0].numpy().reshape(pixels.shape)
    return result
