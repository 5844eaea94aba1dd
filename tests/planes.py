"""A plane, the simplest surface whose features are known at every point of a pixel."""

from __future__ import annotations

import torch
from torch import Tensor

from mcdenoise.frame import Frame

HEIGHT, WIDTH = 40, 60


def plane(offsets: Tensor | None = None) -> Frame:
    """A plane with random color, whose inverse depth is linear in the image.

    Args:
        offsets: ``(2, HEIGHT, WIDTH)``, points of the pixels through which it is seen; by default their centres.
    """
    rows, columns = torch.meshgrid(torch.arange(float(HEIGHT)), torch.arange(float(WIDTH)), indexing="ij")
    across, down = torch.zeros(2, 1, 1) if offsets is None else offsets
    inverse = 0.2 + 0.004 * (columns + across) + 0.003 * (rows + down)
    normal = torch.tensor([0.6, 0.0, -0.8]).reshape(1, 3, 1, 1).expand(1, 3, HEIGHT, WIDTH)
    return Frame(torch.rand(1, 3, HEIGHT, WIDTH), normal=normal, depth=(1 / inverse)[None, None])
