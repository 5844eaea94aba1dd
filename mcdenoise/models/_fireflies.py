"""Which bright pixels are fireflies, and how much light they have: not those that were bright in the frame before."""

from __future__ import annotations

import itertools

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.models._reads import at_hand
from mcdenoise.ops._steps.history import incoming

# A pixel may be this many times as bright as it was in the frame before. What is clamped there is believed a little
# more in every frame, so that a star a thousand times as bright as its sky has its light from the fourth or fifth frame
# on, while two fireflies in one place remain fireflies.
GAIN = 6.0
# Side of a block in pixels; number of rows of blocks that are examined; and the least number of lit blocks.
_BLOCK, _STRIPS, _LEAST_BLOCKS = 32, 16, 16


def steady(light: Tensor, clamped: Tensor, before: Tensor, motion: Tensor | None) -> Tensor | None:
    """The clamped light, and where it was bright before as much more as that allows.

    Args:
        light: ``(B, 3, H, W)`` before clamping.
        clamped: ``(B, 3, H, W)`` after it.
        before: ``(B, C, H, W)`` of the frames before, clamped: three channels, or their sum.
        motion: ``(B, 2, H, W)`` to the frame before; ``None`` if nothing moves, or where nothing tells what does.

    Returns:
        ``(B, 3, H, W)``; ``None``, if values can be read, where it would be the clamped light.
    """
    full, least, allowed = (image.sum(1, keepdim=True) for image in (light, clamped, before.detach()))
    known = at_hand(light.device)
    if known and not (full > least).any():
        return None
    bound = torch.maximum(GAIN * _moved(allowed, motion), least)
    passes = (full > least) & (bound > least)
    if known and not passes.any():
        return None
    ratio = torch.minimum(bound / torch.where(full > 0, full, 1), torch.ones_like(full))
    return torch.where(passes, light * ratio, clamped)


def _moved(image: Tensor, motion: Tensor | None) -> Tensor:
    """The largest of the pixels around the place of each pixel in the frame before; 0 outside of it.

    A light of one pixel that moves by a third of a pixel stays in its pixel twice, and then is in the next one.
    """
    if motion is None:
        return image
    height, width = image.shape[2:]
    motion = motion.to(torch.promote_types(motion.dtype, torch.float32)).nan_to_num(torch.inf)
    x = torch.arange(width, device=image.device) + motion[:, 0]
    y = torch.arange(height, device=image.device)[:, None] + motion[:, 1]
    found = torch.zeros_like(image)
    for row, column in itertools.product((y.floor(), y.ceil()), (x.floor(), x.ceil())):
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        place = torch.where(inside, row, 0).long() * width + torch.where(inside, column, 0).long()
        there = image.flatten(1).gather(1, place.flatten(1)).reshape_as(image)
        found = torch.where(inside[:, None], torch.maximum(found, there), found)
    return found


def clamped_fraction(light: Tensor, clamped: Tensor) -> Tensor:
    """``(B,)`` fraction of the light of each image that clamping takes; both are ``(B, 3, H, W)``."""
    before, after = (image.detach().mean((1, 2, 3)) for image in (light, clamped))
    return torch.where(before > 0, (before - after) / torch.where(before > 0, before, 1), 0)


def light_of_fireflies(color: Tensor) -> Tensor:
    """Fraction of the light of the median 32x32 block that clamping takes.

    Args:
        color: ``(B, 3, H, W)`` radiance without albedo, finite and non-negative.

    Returns:
        ``(B,)``; 0 for images with fewer than 16 lit blocks.
    """
    color = color.detach()
    height = color.shape[-2]
    step = _BLOCK * -(-height // (_BLOCK * _STRIPS))
    # A graph for images of any size has no strips.
    whole = step == _BLOCK or torch.compiler.is_compiling()
    strips = [color] if whole else [color[..., top : top + _BLOCK, :] for top in range(0, height, step)]
    fractions = []
    for strip in strips:
        light = strip.to(torch.promote_types(color.dtype, torch.float32))
        before, after = (
            F.avg_pool2d(image.mean(1, keepdim=True), _BLOCK, ceil_mode=True, count_include_pad=False)
            for image in (light, incoming(light, compared=False))
        )
        # Not a number where there is no light to lose.
        fractions.append((1 - after / before).flatten(1))
    lost = torch.cat(fractions, 1)
    # The lower median of all numbers, like nanmedian, which ONNX lacks.
    known = (~lost.isnan()).sum(1, keepdim=True)
    ascending = torch.where(lost.isnan(), torch.inf, lost).sort(1).values
    median = ascending.gather(1, (known - 1).clamp_min(0) // 2)
    return torch.where(known >= _LEAST_BLOCKS, median, 0)[:, 0]
