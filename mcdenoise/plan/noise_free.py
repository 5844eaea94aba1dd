"""Pixels that have no noise: background, emitters, and their mirror images."""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.buffers import Inspected
from mcdenoise.ops import NO_ALBEDO

# Of the mean of two pixels; one sample of a path tracer differs from the next by ten times as much or more.
_SMOOTH = 0.02
_CELL = 8
# Of the 576 pixels of nine cells.
_LEAST_WITNESSES = 100


def noise_free(inspected: Inspected) -> Tensor | None:
    """Pixels whose radiance has no noise to remove.

    Nothing was hit there, or what was hit has no albedo and is bright. And in the cell of 8x8 pixels and those around
    it, where at least 100 pixels are of this kind, no two of them side by side differ by more than 2 %. Fog before a
    background, a rough mirror, or glass that reflects one sample and refracts the next do not pass; nor does a
    background of detail, such as stars, which has no noise but cannot be told from it.

    Args:
        inspected: a frame with its depth. Without a depth, nothing is known to be background; without an albedo,
            nothing to be an emitter.

    Returns:
        ``(B, 1, H, W)`` bool, or ``None`` where there is no such pixel.
    """
    frame, _, ranges = inspected
    brightness = _combined(torch.add, frame.color)
    kinds = []
    if frame.depth is not None and ranges.get("depth", (0.0, torch.inf))[1] == torch.inf:
        kinds.append(frame.depth == torch.inf)
    if frame.albedo is not None and ranges["albedo"][0] < NO_ALBEDO:
        kinds.append((_combined(torch.maximum, frame.albedo) < NO_ALBEDO) & (brightness > 0))
    plain = kinds[0] if len(kinds) == 1 else kinds[0] | kinds[1] if kinds else None
    if plain is None or not plain.any():
        return None
    rough = torch.zeros_like(brightness)
    for dim in (-2, -1):
        rough.narrow(dim, 0, rough.shape[dim] - 1).add_(_jumps(brightness, plain, dim))
    clean = F.max_pool2d(_cells(rough, F.max_pool2d), 3, 1, 1) == 0
    witnesses = F.avg_pool2d(_cells(plain.to(rough.dtype), F.avg_pool2d), 3, 1, 1) * (9 * _CELL**2)
    cells = clean & (witnesses >= _LEAST_WITNESSES)
    if not cells.any():
        return None
    wide = cells.repeat_interleave(_CELL, -2).repeat_interleave(_CELL, -1)
    return plain & wide[..., : plain.shape[-2], : plain.shape[-1]]


def _combined(operator: Callable[[Tensor, Tensor], Tensor], image: Tensor) -> Tensor:
    """A reduction over three channels takes many times as long."""
    return operator(operator(image[:, :1], image[:, 1:2]), image[:, 2:])


def _jumps(brightness: Tensor, plain: Tensor, dim: int) -> Tensor:
    """Where a pixel and the next along an axis are both of the kind, and differ."""
    count = brightness.shape[dim] - 1
    here, there = brightness.narrow(dim, 0, count), brightness.narrow(dim, 1, count)
    both = plain.narrow(dim, 0, count) & plain.narrow(dim, 1, count)
    return ((here - there).abs() > _SMOOTH / 2 * (here + there)) & both


def _cells(image: Tensor, pool: Callable[..., Tensor]) -> Tensor:
    height, width = image.shape[-2:]
    return pool(F.pad(image, (0, -width % _CELL, 0, -height % _CELL)), _CELL)
