"""Radiance and display values, and writing radiance to a file of any format, which the ending of its name tells."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import torch
from torch import Tensor

from mcdenoise.data.exr import write_image
from mcdenoise.data.images import FORMATS, Image, Part
from mcdenoise.errors import InputError

# Type of the stored numbers; those of whole numbers are display values.
_TYPES = {"openexr": "half", "hdr": "float", "pnm": "float", "tiff": "uint16", "png": "uint8"}


def write_radiance(path: Path, image: Image) -> float:
    """Write scene-linear radiance, atomically: PFM and HDR as it is, EXR as half floats, TIFF and PNG on sRGB's curve.

    Args:
        path: the file; its folder must exist.
        image: ``(H, W, 3)``, top row first. In TIFF and PNG, values above white are clamped.

    Returns:
        The fraction of the pixels that were clamped.

    Raises:
        InputError: the format is unknown, or the file cannot be written.
    """
    kind = FORMATS.get(path.suffix.lower())
    if kind is None:
        raise InputError(f"{path}: expected a name that ends in one of {', '.join(FORMATS)}, found '{path.suffix}'")
    spec = oiio.ImageSpec(image.shape[1], image.shape[0], image.shape[2], _TYPES[kind])
    clamped = 0.0
    if kind in ("tiff", "png"):
        clamped = float((image > 1).any(-1).mean())
        image = encode(image)
        spec.attribute("oiio:ColorSpace", "sRGB")
    write_image(path, spec, np.asarray(image, np.float32))
    return clamped


def light_of(pixels: Image, part: Part) -> Image:
    """Convert stored colors ``(..., C)`` to linear light that is multiplied by its alpha, the fourth channel."""
    if not (part.display_referred or part.straight):
        return pixels
    color, rest = pixels[..., :3], pixels[..., 3:]
    color = decode(color, part.gamma) if part.display_referred else color
    return np.concatenate([color * rest[..., :1] if part.straight and rest.size else color, rest], -1)


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
