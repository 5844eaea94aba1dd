"""Colours of other primaries: what an EXR says of its own, brought to those that every metric assumes."""

from __future__ import annotations

import importlib
import sys
import warnings
from typing import Any

import numpy as np
import OpenImageIO as oiio
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
        The same shape and dtype; the white is adapted by the Bradford transform. Saturated colours may be negative.

    Raises:
        InputError: the chromaticities are no colour space.
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
    """``(3, 3)`` RGB to Rec. 709; ``None`` where the primaries span no colours."""
    colour = import_colour()
    target = colour.RGB_COLOURSPACES["ITU-R BT.709"]
    try:
        space = colour.RGB_Colourspace("file", points[:3], points[3])
        matrix = colour.matrix_RGB_to_RGB(space, target, chromatic_adaptation_transform="Bradford")
    except np.linalg.LinAlgError:
        return None
    return torch.from_numpy(matrix) if np.isfinite(matrix).all() else None


def import_colour() -> Any:
    """The package colour-science; loading it takes a second, and few files need it."""
    modules: dict[str, Any] = sys.modules
    with warnings.catch_warnings():
        # It warns of packages for plots that it does not find.
        warnings.simplefilter("ignore")
        # It would keep OpenImageIO alive to the end of the process, which prints pages of leaks then.
        modules["OpenImageIO"] = None
        try:
            return importlib.import_module("colour")
        finally:
            modules["OpenImageIO"] = oiio
