"""The cells of a bilateral grid in space."""

from __future__ import annotations

import torch
from torch import Tensor

from mcdenoise.ops._constants import TENT_ROUNDING
from mcdenoise.ops._window import parts_of


def tent(distance: Tensor) -> Tensor:
    """The weight of a pixel at a distance in cells: 1 in the centre of the cell, 0 from a distance of 1 on."""
    return torch.relu(1 - torch.sqrt(distance.square() + TENT_ROUNDING))


def spatial_taps(side: int, cell: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """``(2, side)`` the two cells whose centres are around each pixel, from -1 on, and their weights.

    The weights have dtype and device of ``like``, and are 0 beyond the grid.
    """
    # Twice the pixel's centre, in pixels: whole numbers, so that a distance is rounded once.
    centre = 2 * torch.arange(side, device=like.device) + 1
    first = torch.div(centre - cell, 2 * cell, rounding_mode="floor")
    cells = torch.stack([first, first + 1])
    distance = (centre - cell * (2 * cells + 1)).to(like.dtype) / (2 * cell)
    return cells, tent(distance) * ((cells >= 0) & (cells < parts_of(side, cell)))
