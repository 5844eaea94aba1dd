"""Planes, the simplest surfaces: their features are known at every point of a pixel."""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from mcdenoise.data.camera_path import Camera
from mcdenoise.frame import Frame

HEIGHT, WIDTH = 40, 60


def plane(offsets: Tensor | None = None) -> Frame:
    """A plane with random color, whose inverse depth is linear in the image; offsets are from pixel centres."""
    rows, columns = torch.meshgrid(torch.arange(float(HEIGHT)), torch.arange(float(WIDTH)), indexing="ij")
    across, down = torch.zeros(2, 1, 1) if offsets is None else offsets
    inverse = 0.2 + 0.004 * (columns + across) + 0.003 * (rows + down)
    normal = torch.tensor([0.6, 0.0, -0.8]).reshape(1, 3, 1, 1).expand(1, 3, HEIGHT, WIDTH)
    return Frame(torch.rand(1, 3, HEIGHT, WIDTH), normal=normal, depth=(1 / inverse)[None, None])


def leaning_wall(number: int, width: int, height: int, step: float = 1.0) -> dict[str, Tensor]:
    """Features of a wall, with depths that differ from pixel to pixel, and its camera, which moves along it."""
    eye = torch.tensor([0.03, 0.02, 0.0]) * number * step
    rows, columns = torch.arange(height).float(), torch.arange(width).float()
    ray = torch.ones(3, height, width)
    ray[0], ray[1] = (2 * columns + 1) / width - 1, ((2 * rows[:, None] + 1) / height - 1) * height / width
    depth = 4 / (1 + 0.2 * ray[0])
    position = eye[:, None, None] + ray * depth
    matrix = torch.zeros(1, 4, 4)
    matrix[:, 0, 0], matrix[:, 1, 1], matrix[:, 2, 2], matrix[:, 2, 3] = 1, width / height, 1, 1
    matrix[:, 3, :3] = -torch.stack([eye[0], eye[1] * width / height, torch.tensor(0.1)])
    normal = torch.tensor([-0.2, 0.0, -1.0]).reshape(1, 3, 1, 1).expand(1, 3, height, width) / 1.04**0.5
    features = {"albedo": 0.3 + 0.4 * (position - position.floor())[None], "normal": normal}
    return features | {"depth": depth[None, None], "position": position[None], "view_projection": matrix}


def random_shot(seed: int, height: int = 80, width: int = 112, frames: int = 3) -> list[Frame]:
    """Frames of random values, that move by a motion of their seed; by default large enough for compiled kernels."""
    g = torch.Generator().manual_seed(seed)

    def images(channels: int) -> Tensor:
        return torch.rand(1, channels, height, width, generator=g)

    still: dict[str, Any] = {
        "albedo": images(3),
        "normal": functional.normalize(images(3) - 0.5),
        "depth": 1 + images(1),
        "position": images(3),
        "motion": torch.full((1, 2, height, width), 5.0 * seed),
        "view_projection": torch.eye(4)[None] + 0.01 * seed,
    }
    return [Frame(color=images(3), **still) for _ in range(frames)]


def exponential(*size: int, seed: int) -> Tensor:
    """Noise of mean 1, as that of single paths."""
    return -torch.log(torch.rand(size, generator=torch.Generator().manual_seed(seed)).clamp_min(1e-6))


def synthetic(width: int, height: int, seed: int = 0) -> Frame:
    """Noise on a checkered floor under a sky that nothing is hit in, with motion."""
    rows, columns = torch.meshgrid(torch.arange(height) / height, torch.arange(width) / height, indexing="ij")
    floor = (rows > 0.3)[None, None]
    checker = ((rows * 8).floor() + (columns * 8).floor()) % 2
    albedo = (0.2 + 0.6 * checker).expand(1, 3, -1, -1) * floor
    normal = torch.tensor([0.0, 1.0, 0.0]).reshape(1, 3, 1, 1) * floor
    return Frame(
        color=torch.where(floor, albedo * exponential(1, 3, height, width, seed=seed), 0.7),
        albedo=albedo,
        normal=normal,
        depth=torch.where(floor, 1 / rows.clamp_min(0.1), torch.inf),
        motion=torch.full((1, 2, height, width), 0.3),
    )


class Rays(NamedTuple):
    """Rays from an origin ``(3,)`` in unit directions ``(H*W, 3)``."""

    origin: Any
    directions: Any


def pixel_rays(camera: Camera, width: int, height: int) -> Rays:
    """The rays of a camera through the centres of pixels, row by row from the top left, in world space."""
    tan = math.tan(math.radians(camera.fov_x) / 2)
    # Camera x points left, camera y up.
    x, y = (1 - (2 * np.arange(side) + 1) / side for side in (width, height))
    across, down = np.meshgrid(x * tan, y * (tan * height / width))
    ways = np.stack([across, down, np.ones_like(across)], -1).reshape(-1, 3) @ camera.to_world[:3, :3].T
    return Rays(camera.to_world[:3, 3], ways / np.linalg.norm(ways, axis=1, keepdims=True))


def seen_at(position: Any, matrix: Any) -> tuple[Any, Any, Any]:
    """Columns and rows in the image of world positions ``(H, W, 3)``, and their places in clip space."""
    height, width, _ = position.shape
    clip = np.concatenate([position, np.ones((height, width, 1))], -1) @ np.asarray(matrix, np.float64)
    return (clip[..., 0] / clip[..., 3] + 1) / 2 * width, (clip[..., 1] / clip[..., 3] + 1) / 2 * height, clip
