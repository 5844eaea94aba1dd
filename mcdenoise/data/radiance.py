"""Writing radiance to a file of any format, which the ending of its name tells."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from mcdenoise.data.exr import Image, write_image
from mcdenoise.data.images import FORMATS
from mcdenoise.data.readers.transfer import encode
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
