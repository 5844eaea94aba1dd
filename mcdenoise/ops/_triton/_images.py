"""Shared by kernels over images: how they are launched, how they read and write, and functions that Triton lacks.

A program has a tile of pixels, one for each thread. Images are read in whatever layout and precision they have, and
computed with in the precision of the sums.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from mcdenoise.ops._triton._filter import _COLUMNS, _ROWS, _TYPES, _is_wide, _source
from mcdenoise.ops._triton._filter import _is_inside as is_inside
from mcdenoise.ops._triton._filter import _read_plane as read_plane
from mcdenoise.ops._triton._filter import _tile as tile
from mcdenoise.ops._triton._filter import _write_plane as write_plane
from mcdenoise.ops._window import accumulator_dtype

__all__ = ["expm1", "is_finite", "is_inside", "launch", "log1p", "read_plane", "sums_of", "tile", "write_plane"]


def sums_of(*tensors: Tensor | None) -> torch.dtype:
    """The dtype of sums over such tensors."""
    dtype = torch.float32
    for tensor in tensors:
        dtype = dtype if tensor is None else torch.promote_types(dtype, accumulator_dtype(tensor.dtype))
    return dtype


def launch(kernel: Any, like: Tensor, dtype: torch.dtype, *given: Tensor | None, **settings: Any) -> None:
    """Run a kernel on all pixels of an image.

    Args:
        kernel: takes each tensor as a source, one of no channels where there is none; height and width; the settings.
        like: ``(B, C, H, W)`` that has the pixels.
        dtype: of the sums.
        given: ``(B, C, H, W)`` each, or of one pixel: results and images.
        settings: constants that the kernel is compiled for.
    """
    batch, _, height, width = like.shape
    if not batch * height * width:
        return
    nothing = torch.empty((batch, 0, 1, 1), dtype=dtype, device=like.device)
    tensors = [nothing if tensor is None else tensor for tensor in given]
    grid = triton.cdiv(width, _COLUMNS), triton.cdiv(height, _ROWS), batch
    # Triton launches on the current device.
    with torch.cuda.device_of(like):
        kernel[grid](
            *map(_source, tensors),
            height,
            width,
            **settings,
            ROWS=_ROWS,
            COLUMNS=_COLUMNS,
            WIDE=any(map(_is_wide, tensors)),
            SUM=_TYPES[dtype],
        )


@triton.jit
def is_finite(x: tl.tensor) -> tl.tensor:
    """Neither infinite nor NaN."""
    return tl.abs(x) < float("inf")


@triton.jit
def log1p(x: tl.tensor) -> tl.tensor:
    """Kahan's formula: rounding of the sum cancels with that of the difference."""
    u = 1 + x
    difference = u - 1
    exact = difference == 0
    return tl.where(exact, x, tl.log(u) * (x / tl.where(exact, 1, difference)))


@triton.jit
def expm1(x: tl.tensor) -> tl.tensor:
    """Kahan's, of ``x >= 0``."""
    u = tl.exp(x)
    small = u == 1
    # Beyond, the one is less than rounding is, and infinity would be divided by itself.
    near = x < 30
    inner = tl.where(small | ~near, 2, u)
    found = (inner - 1) * (x / tl.log(inner))
    return tl.where(small, x, tl.where(near, found, u - 1))
