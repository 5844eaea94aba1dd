"""Which bright pixels are fireflies, and how much light they have: not those that were bright in the frames before."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from mcdenoise.models._interface import at_hand
from mcdenoise.ops import clamp_fireflies
from mcdenoise.ops._window import block_means

# Of a pixel that is clamped in several frames in a row, the first one is believed to be as bright as its neighbours,
# and each later one this many times as bright as the one before. So a star a thousand times as bright as its sky has
# its light from the fifth frame on, while two fireflies in one place remain fireflies, also where the limit is 15.
_GAIN = 6.0
# Side of a block in pixels, and the least number of lit blocks.
_BLOCK, _LEAST_BLOCKS = 32, 16


def believed(full: Tensor, least: Tensor, limit: Tensor, before: Tensor | None, motion: Tensor | None) -> Tensor:
    """How much of the light of each pixel lasts, and so is no firefly: what is above the clamped light passes.

    Args:
        full: ``(B, 1, H, W)`` light before clamping, see :func:`light_of`.
        least: ``(B, 1, H, W)`` after it.
        limit: ``(B, 1, 1, 1)`` of :func:`mcdenoise.ops.clamp_fireflies`.
        before: the result for the frame before; ``None`` for a first frame.
        motion: ``(B, 2, H, W)`` to the frame before; ``None`` if nothing moves, or where nothing tells what does.

    Returns:
        ``(B, 1, H, W)``, at most ``full``, without derivatives.
    """
    full, least = full.detach(), least.detach()
    neighbours, bright = least / limit, full > least
    if before is None:
        return neighbours
    if at_hand(full.device):
        batch, _, rows, columns = bright.nonzero(as_tuple=True)
        if not len(rows):
            return neighbours
        place = (batch, torch.zeros_like(batch), rows, columns)
        bound = _GAIN * _moved(before, motion, batch, rows, columns)
        return neighbours.index_put(place, torch.maximum(neighbours[place], torch.minimum(full[place], bound)))
    (count, _, height, width), device = full.shape, full.device
    batch = torch.arange(count, device=device)[:, None, None]
    bound = _moved(
        before, motion, batch, torch.arange(height, device=device)[:, None], torch.arange(width, device=device)
    )
    bound = _GAIN * bound[:, None]
    return torch.where(bright, torch.maximum(neighbours, torch.minimum(full, bound)), neighbours)


def _moved(image: Tensor, motion: Tensor | None, batch: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """The largest of the pixels around the places of some pixels in the frame before; 0 outside of it.

    A light of one pixel that moves by a third of a pixel stays in its pixel twice, and then is in the next one.
    """
    if motion is None:
        return _at(image[:, 0], batch, rows, columns)
    height, width = image.shape[2:]
    motion = motion.to(torch.promote_types(motion.dtype, torch.float32))
    x, y = (_at(motion[:, axis], batch, rows, columns).nan_to_num(torch.inf) for axis in (0, 1))
    x, y = columns + x, rows + y
    found = torch.zeros_like(x, dtype=image.dtype)
    for row, column in itertools.product((y.floor(), y.ceil()), (x.floor(), x.ceil())):
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        place = (torch.where(inside, each, 0).long() for each in (row, column))
        found = torch.where(inside, torch.maximum(found, _at(image[:, 0], batch, *place)), found)
    return found


def _at(image: Tensor, batch: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """Pixels of images ``(B, H, W)``; graphs in ONNX have no other way for images of any size."""
    height, width = image.shape[1:]
    place = (batch * height + rows) * width + columns
    return image.flatten().index_select(0, place.flatten()).reshape(place.shape)


def light_of(color: Tensor) -> Tensor:
    """``(B, 1, H, W)`` sum of the three channels; a reduction over them takes many times as long."""
    return color[:, :1] + color[:, 1:2] + color[:, 2:]


def with_light(color: Tensor, before: Tensor, after: Tensor) -> Tensor:
    """The color of pixels whose light, as a whole or of each channel, was one and shall be another."""
    # A quotient of equal numbers is exactly 1. The derivative of 0 / 0 would be NaN.
    lit = before > 0
    factor = torch.where(lit, after / torch.where(lit, before, 1), 1)
    return (color * factor).to(color.dtype)


def light_of_fireflies(color: Tensor) -> Tensor:
    """Fraction of the light of the median 32x32 block that clamping takes.

    Args:
        color: ``(B, 3, H, W)`` radiance without albedo, finite and non-negative.

    Returns:
        ``(B,)``; 0 for images with fewer than 16 lit blocks.
    """
    light = color.detach().to(torch.promote_types(color.dtype, torch.float32))
    before, after = (
        block_means(image.mean(1, keepdim=True), _BLOCK).flatten(1) for image in (light, clamp_fireflies(light))
    )
    # Not a number where there is no light to lose.
    lost = 1 - after / before
    # The lower median of all numbers, like nanmedian, which ONNX lacks.
    known = (~lost.isnan()).sum(1, keepdim=True)
    ascending = torch.where(lost.isnan(), torch.inf, lost).sort(1).values
    median = ascending.gather(1, (known - 1).clamp_min(0) // 2)
    return torch.where(known >= _LEAST_BLOCKS, median, 0)[:, 0]
