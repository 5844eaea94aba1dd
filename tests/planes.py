"""Planes, the simplest surfaces: their features are known at every point of a pixel."""

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


def synthetic(width: int, height: int, seed: int = 0) -> Frame:
    """Noise on a checkered floor under a sky that nothing is hit in, with motion."""
    generator = torch.Generator().manual_seed(seed)
    rows, columns = torch.meshgrid(torch.arange(height) / height, torch.arange(width) / height, indexing="ij")
    floor = (rows > 0.3)[None, None]
    checker = ((rows * 8).floor() + (columns * 8).floor()) % 2
    noise = -torch.log(torch.rand(1, 3, height, width, generator=generator).clamp_min(1e-6))
    albedo = (0.2 + 0.6 * checker).expand(1, 3, -1, -1) * floor
    normal = torch.tensor([0.0, 1.0, 0.0]).reshape(1, 3, 1, 1) * floor
    return Frame(
        color=torch.where(floor, albedo * noise, 0.7),
        albedo=albedo,
        normal=normal,
        depth=torch.where(floor, 1 / rows.clamp_min(0.1), torch.inf),
        motion=torch.full((1, 2, height, width), 0.3),
    )
