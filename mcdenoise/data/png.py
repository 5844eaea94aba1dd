"""PNG pictures through OpenImageIO: images side by side with captions, for people to look at."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from mcdenoise.data.files import atomic_path
from mcdenoise.errors import InputError

Picture = NDArray[np.uint8]

_CAPTION_HEIGHT = 28


def write_png(path: Path, picture: Picture) -> None:
    """Write an 8-bit picture, whole or not at all.

    Args:
        path: the file to be written. Its folder must exist.
        picture: ``(H, W, 3)``.

    Raises:
        InputError: the file cannot be written.
    """
    height, width, channels = picture.shape
    with atomic_path(path) as temporary:
        buffer = oiio.ImageBuf(oiio.ImageSpec(width, height, channels, "uint8"))
        buffer.set_pixels(oiio.ROI(0, width, 0, height), np.ascontiguousarray(picture))
        if not buffer.write(str(temporary)):
            reason = buffer.geterror().splitlines()[0]
            raise InputError(f"{path}: cannot be written ({reason}); check the folder, its permissions and free space")


def caption(picture: Picture, text: str) -> Picture:
    """The picture with a line of white text on black above it."""
    width = picture.shape[1]
    band = oiio.ImageBuf(oiio.ImageSpec(width, _CAPTION_HEIGHT, 3, "uint8"))
    oiio.ImageBufAlgo.zero(band)
    oiio.ImageBufAlgo.render_text(band, 6, _CAPTION_HEIGHT - 9, text, 17, "DroidSans", (1.0, 1.0, 1.0))
    pixels = np.asarray(band.get_pixels("uint8"), dtype=np.uint8)
    return np.concatenate([pixels.reshape(_CAPTION_HEIGHT, width, 3), picture])


def enlarge(picture: Picture, factor: int) -> Picture:
    """Every pixel as a square of ``factor`` pixels, so that a close-up shows what is there."""
    return picture.repeat(factor, 0).repeat(factor, 1)
