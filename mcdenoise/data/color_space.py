"""Colours of other primaries: what an EXR says of its own, brought to those that every metric assumes."""

from __future__ import annotations

import importlib

import numpy as np
import torch
from torch import Tensor

from mcdenoise.data.exr import Metadata
from mcdenoise.errors import InputError

# Red, green, blue and white of Rec. 709, as OpenEXR stores them; a file without the attribute has these.
_REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
# Far below a visible difference, and above the rounding of what writers store.
_CLOSE = 1e-3


def to_rec709(image: Tensor, metadata: Metadata) -> Tensor:
    """Scene-linear RGB with the primaries of Rec. 709, and so of sRGB.

    Args:
        image: ``(..., 3, H, W)`` scene-linear radiance.
        metadata: of its file: ``chromaticities`` has x and y of red, green, blue and white. Without it, and where these
            are Rec. 709's to 0.001, the image is returned as it is.

    Returns:
        The same shape and dtype; the white is adapted by the Bradford transform. Saturated colors may be negative.

    Raises:
        InputError: the chromaticities are no colour space.
    """
    stored = metadata.get("chromaticities")
    if stored is None or np.allclose(np.resize(np.asarray(stored, float), 8), _REC709, atol=_CLOSE):
        return image
    # Loading it takes a second, and few files need it.
    colour = importlib.import_module("colour")
    try:
        points = np.asarray(stored, float).reshape(4, 2)
        space = colour.RGB_Colourspace("file", points[:3], points[3])
        target = colour.RGB_COLOURSPACES["ITU-R BT.709"]
        matrix = colour.matrix_RGB_to_RGB(space, target, chromatic_adaptation_transform="Bradford")
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        raise InputError(
            f"chromaticities: expected x and y of red, green, blue and white, found {stored}; remove the attribute"
        ) from error
    return torch.einsum("ji,...ihw->...jhw", torch.from_numpy(matrix).to(image), image)
