"""Pixels without noise: background, emitters, and their mirror images."""

from __future__ import annotations

import functools

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.frame import Frame
from mcdenoise.models._fireflies import light_of
from mcdenoise.models._interface import at_hand
from mcdenoise.ops import NO_ALBEDO
from mcdenoise.ops._window import of_blocks, up_to_multiple

# Relative difference of two pixels. Consecutive samples of a path tracer differ by ten times as much or more.
_SMOOTH = 0.02
_CELL = 8
# Numbers among the 576 pixels of 3x3 cells.
_LEAST_WITNESSES, _MANY = 100, 1000


def noise_free(frame: Frame) -> Tensor | None:
    """Find pixels whose radiance has no noise to remove.

    In such a pixel nothing was hit, or the surface has no albedo and is bright. In addition, the 3x3 cells of 8x8
    pixels around it must contain at least 100 such pixels, and no two adjacent ones may differ by more than 2 %. This
    test rejects fog before a background, rough mirrors, and glass that reflects one sample and refracts the next. It
    also rejects a detailed background, such as stars, which has no noise but cannot be told from noise.

    Args:
        frame: its depth identifies the background, and its albedo the emitters. Only the radiance of the current frame
            is used, not the history; the albedo may have been divided out.

    Returns:
        ``(B, 1, H, W)`` bool, or ``None`` if it is known that no pixel qualifies.
    """
    kinds = []
    current = frame.color if frame.current is None else frame.current
    brightness = light_of(current.detach())
    if frame.depth is not None:
        kinds.append(frame.depth == torch.inf)
    if frame.albedo is not None:
        # A reduction over the channels would take many times as long.
        brightest = functools.reduce(torch.maximum, frame.albedo.detach().split(1, 1))
        kinds.append((brightest < NO_ALBEDO) & (brightness > 0))
    if not kinds:
        return None
    known = kinds[0] if len(kinds) == 1 else kinds[0] | kinds[1]
    band, looks = slice(None), at_hand(current.device)
    if looks:
        rows = known.any(-1).flatten(0, -2).any(0).nonzero()
        if not len(rows):
            return None
        # Crop to whole cells; the rows above and below contain no such pixel.
        band = slice(int(rows[0]) // _CELL * _CELL, (int(rows[-1]) // _CELL + 1) * _CELL)
    plain, brightness = known[..., band, :], brightness[..., band, :]
    # Comparisons with NaN are false in both directions.
    plainly = torch.where(plain, brightness, torch.nan)
    lowest = plainly * ((1 + _SMOOTH / 2) / (1 - _SMOOTH / 2))
    rough = torch.zeros_like(plain)
    for dim in (-2, -1):
        count = plain.shape[dim] - 1
        here, here_lowest = (image.narrow(dim, 0, count) for image in (plainly, lowest))
        there, there_lowest = (image.narrow(dim, 1, count) for image in (plainly, lowest))
        rough.narrow(dim, 0, count).logical_or_((here > there_lowest) | (there > here_lowest))
    # One sum for both tests: a single difference outweighs all votes.
    counted = plain.to(brightness.dtype).add_(rough, alpha=_MANY)
    sums = F.avg_pool2d(up_to_multiple(counted, _CELL), _CELL)
    witnesses = (F.avg_pool2d(sums, 3, 1, 1) * (9 * _CELL**2)).round()
    cells = (witnesses >= _LEAST_WITNESSES) & (witnesses < _MANY)
    if looks and not cells.any():
        return None
    found = torch.zeros_like(known)
    found[..., band, :] = plain & of_blocks(cells, _CELL, *plain.shape[-2:])
    return found
