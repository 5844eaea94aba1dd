"""Buffers from arrays, as renderers' Python interfaces provide them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from mcdenoise.buffers import BUFFERS, MATRIX, Layout
from mcdenoise.errors import InputError


def of_array(name: str, value: ArrayLike, layout: Layout, size: tuple[int, int] | None) -> Tensor:
    """Convert an array to a buffer with a batch of one; ``size`` is that of color, and ``None`` for color itself."""
    array = _floats(name, value)
    if name == MATRIX:
        if array.shape != (4, 4):
            raise InputError(f"buffer '{name}': expected shape (4, 4), found {array.shape}")
        return torch.from_numpy(array)[None]
    # Buffers outside the vocabulary, and samples, may have any number of channels.
    wanted = BUFFERS[name].channels if name in BUFFERS else None
    axis, axes = -1 if layout == "HWC" else -3, 4 if name == "samples" else 3
    found = array.shape
    if array.ndim == 2 and (wanted in (1, None) or name == "color"):
        array = np.expand_dims(array, axis)
    if name == "color" and array.ndim == axes and array.shape[axis] == 1:
        array = np.repeat(array, 3, axis)
    fits = array.ndim == axes and 0 not in array.shape and wanted in (None, array.shape[axis])
    image = np.moveaxis(array, axis, -3) if fits else array
    if not fits or image.shape[-2:] != (size or image.shape[-2:]):
        height, width = size or ("H", "W")
        expected = [height, width, wanted or "C"] if layout == "HWC" else [wanted or "C", height, width]
        listed = ", ".join(str(each) for each in (["S", *expected] if name == "samples" else expected))
        like = f"{' or ' + str(size) if wanted == 1 else ''} like 'color'" if size else ""
        advice = "" if size else _advice(array, axis)
        raise InputError(f"buffer '{name}': expected shape ({listed}){like}, found {found}{advice}")
    return torch.from_numpy(image)[None]


def unmasked(color: ArrayLike, layout: Layout) -> tuple[ArrayLike, NDArray[np.float32] | None]:
    """A color without numpy's mask, and the mask as a buffer ``(H, W)``: 0 where a channel is masked."""
    if not isinstance(color, np.ma.MaskedArray):
        return color, None
    masked = np.ma.getmaskarray(color)
    axis = -1 if layout == "HWC" else 0
    return np.ma.getdata(color), 1 - np.asarray(masked.any(axis) if masked.ndim == 3 else masked).astype(np.float32)


def _advice(color: NDArray[Any], axis: int) -> str:
    """Advice for an array that has not the shape of a color."""
    if color.ndim == 4:
        return "; pass one image, or tensors (B, C, H, W) to Frame itself"
    if color.ndim == 3 and color.shape[axis] == 4:
        return "; pass its first three channels, and the fourth as alpha"
    if color.ndim == 3 and color.shape[-4 - axis] == 3:
        return f"; pass layout='{'CHW' if axis == -1 else 'HWC'}'"
    return ""


def _floats(name: str, value: ArrayLike) -> NDArray[Any]:
    """An array of floats whose memory torch can share, or a copy."""
    if isinstance(value, Tensor):
        raise InputError(f"buffer '{name}': expected a numpy array, found a torch.Tensor; Frame itself takes tensors")
    if np.ma.is_masked(value):
        raise InputError(
            f"buffer '{name}': expected a plain array, found a masked one; fill it, and pass mask= for void pixels"
        )
    try:
        array = np.asarray(value)
    except (TypeError, ValueError) as error:
        raise InputError(f"buffer '{name}': expected an array, found {type(value).__name__}: {error}") from error
    if array.dtype.kind != "f":
        advice = "convert it with astype(numpy.float32)"
        if array.dtype in (np.uint8, np.uint16):
            advice = f"undo the encoding of a display first, about (x / {np.iinfo(array.dtype).max}) ** 2.2"
        raise InputError(
            f"buffer '{name}': expected a float dtype, as images are scene-linear floats, found {array.dtype}; {advice}"
        )
    if array.dtype.itemsize > 8:
        array = array.astype(np.float64)
    if not array.dtype.isnative:
        array = array.astype(array.dtype.newbyteorder("="))
    shared = array.flags.writeable and all(each >= 0 and each % array.itemsize == 0 for each in array.strides)
    return array if shared else array.copy()
