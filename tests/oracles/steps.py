"""The formulas of the fused steps in float64, written with torch's primitives or with other oracles."""

import torch
from torch import Tensor

from oracles import edges, history


def incoming(color: Tensor) -> Tensor:
    clamped = edges.clamp_fireflies(color)
    mean = clamped.mean(1, keepdim=True)
    return torch.cat([clamped, mean**0.25, mean**0.5], 1)


def lights(root: Tensor) -> Tensor:
    root = root.double()
    batch, _, height, width = root.shape
    found = torch.zeros_like(root)
    for b in range(batch):
        image = root[b, 0]
        for top in range(height - 2):
            for left in range(width - 2):
                block = image[top : top + 3, left : left + 3]
                if block.max() - block.min() <= 0.03 * block.max():
                    found[b, 0, top : top + 3, left : left + 3] = 1
        for y in range(height):
            for x in range(width):
                window = image[max(y - 4, 0) : y + 5, max(x - 4, 0) : x + 5]
                found[b, 0, y, x] *= image[y, x] > 1.2 * window.mean()
    return found


def blend(entering: Tensor, previous: Tensor, previous_length: Tensor, motion: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    color, length = history.accumulate(entering, previous, previous_length, motion)
    return color, length, (length > 1).double().mean((1, 2, 3))
