"""Writing PNG files: single pictures, captions and close-ups."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from mcdenoise.data.exr import write_image
from mcdenoise.data.images import read_picture
from mcdenoise.errors import InputError

Picture = NDArray[np.uint8]

_CAPTION_HEIGHT = 28


def write_png(path: Path, picture: Picture) -> None:
    """Write an 8-bit picture atomically.

    Args:
        path: the file. Its folder must exist.
        picture: ``(H, W, 3)``.

    Raises:
        InputError: the file cannot be written.
    """
    height, width, channels = picture.shape
    spec = oiio.ImageSpec(width, height, channels, "uint8")
    # The default level of 6 takes more than twice as long and saves 6 % of the bytes.
    spec.attribute("png:compressionLevel", 4)
    write_image(path, spec, picture)


def read_png(path: Path) -> Picture:
    """Read an 8-bit picture written by :func:`write_png`.

    Args:
        path: the file.

    Returns:
        ``(H, W, 3)``.

    Raises:
        InputError: the file is missing or damaged.
    """
    pixels = read_picture(path)[2]
    if pixels.shape[2] != 3:
        raise InputError(f"{path}: expected a PNG of 3 channels, found {pixels.shape[2]}")
    return np.rint(pixels * 255).astype(np.uint8)


def caption(picture: Picture, text: str) -> Picture:
    """Add a line of white text on black above the picture."""
    width = picture.shape[1]
    band = oiio.ImageBuf(oiio.ImageSpec(width, _CAPTION_HEIGHT, 3, "uint8"))
    oiio.ImageBufAlgo.zero(band)
    oiio.ImageBufAlgo.render_text(band, 6, _CAPTION_HEIGHT - 9, text, 17, "DroidSans", (1.0, 1.0, 1.0))
    pixels = np.asarray(band.get_pixels("uint8"), dtype=np.uint8)
    return np.concatenate([pixels.reshape(_CAPTION_HEIGHT, width, 3), picture])


def enlarge(picture: Picture, factor: int) -> Picture:
    """Enlarge every pixel to ``factor`` x ``factor`` pixels."""
    return picture.repeat(factor, 0).repeat(factor, 1)
