"""Conversion of colours from the primaries stated in an EXR to Rec. 709, which every metric assumes."""

from __future__ import annotations

import importlib
import sys
import warnings
from typing import Any

import numpy as np
import OpenImageIO as oiio
import torch
from torch import Tensor

from mcdenoise.data.images import Metadata
from mcdenoise.errors import InputError

# Red, green, blue and white of Rec. 709 in OpenEXR's order; a file without the attribute has these primaries.
_REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
# Far below a visible difference, and above writers' rounding errors.
_CLOSE = 1e-3


def to_rec709(image: Tensor, metadata: Metadata) -> Tensor:
    """Convert scene-linear RGB to the primaries of Rec. 709, which are those of sRGB.

    Args:
        image: ``(..., 3, H, W)`` scene-linear radiance.
        metadata: metadata of its file: ``chromaticities`` holds x and y of red, green, blue and white. Without it, or
            if it equals Rec. 709 to 0.001, the image is returned unchanged.

    Returns:
        The same shape and dtype; the white is adapted by the Bradford transform. Saturated colours may be negative.

    Raises:
        InputError: the chromaticities do not define a colour space.
    """
    stored = metadata.get("chromaticities", _REC709)
    if isinstance(stored, tuple) and len(stored) == 8 and np.isfinite(stored).all():
        if np.allclose(stored, _REC709, atol=_CLOSE):
            return image
        matrix = _matrix(np.reshape(stored, (4, 2)))
        if matrix is not None:
            return torch.einsum("ji,...ihw->...jhw", matrix.to(image), image)
    raise InputError(
        f"attribute 'chromaticities': expected x and y of red, green, blue and white, found {stored}; "
        "correct or remove it"
    )


def _matrix(points: np.ndarray[Any, Any]) -> Tensor | None:
    """``(3, 3)`` matrix from RGB to Rec. 709; ``None`` if the primaries are collinear."""
    if abs(np.linalg.det(points[1:3] - points[0])) < _CLOSE:
        return None
    colour = import_colour()
    target = colour.RGB_COLOURSPACES["ITU-R BT.709"]
    try:
        space = colour.RGB_Colourspace("file", points[:3], points[3])
        matrix = colour.matrix_RGB_to_RGB(space, target, chromatic_adaptation_transform="Bradford")
    except np.linalg.LinAlgError:
        return None
    return torch.from_numpy(matrix) if np.isfinite(matrix).all() else None


def import_colour() -> Any:
    """Import colour-science lazily, because it takes a second and few files need it."""
    modules: dict[str, Any] = sys.modules
    with warnings.catch_warnings():
        # It warns about missing plotting packages.
        warnings.simplefilter("ignore")
        # It would keep OpenImageIO alive to the end of the process, which prints pages of leaks then.
        modules["OpenImageIO"] = None
        try:
            return importlib.import_module("colour")
        finally:
            modules["OpenImageIO"] = oiio
