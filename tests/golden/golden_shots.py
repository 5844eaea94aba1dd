"""Two small shots that are the same on every machine, and what the shipped models give for them.

Everything is arithmetic and uniform random numbers in float64, rounded to float32 at the end: where a machine rounds
another way, an input changes by a unit roundoff, which is what the bounds are measured with.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import safe_open
from torch import Tensor

from mcdenoise import Frame

# What the file calls a model, and what the zoo does.
MODELS = {
    "full": "cascaded_v2",
    "small": "cascaded_v2_small",
    "tiny": "cascaded_v2_tiny",
    "micro": "cascaded_v2_micro",
}
PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16}
FILE = Path(__file__).with_name("golden.safetensors")
# Of each image one pixel in nine: of all phases of tiles and of coarser resolutions.
STRIDE = 3
# A convolution rounds weights, activations and results, each a relative change of its products such as the one whose
# response is stored: of the sum of three, the root mean square is at most three times as large. Of a few random changes
# the largest response of a pixel is not the largest of all, but that is hardly four times it (as in
# mcdenoise.check.stability).
ALLOWED = {"largest": 3 * 4, "rms": 3}


@dataclass(frozen=True)
class Shot:
    """A shot.

    Args:
        size: height and width.
        focal: width of the image plane at distance 1 is 2 / focal.
        step: how far the camera moves in a frame, scene units: to the right, and down.
        frames: how many there are.
        kept: indices of those whose image is in the file.
    """

    size: tuple[int, int]
    focal: float
    step: tuple[float, float]
    frames: int
    kept: tuple[int, ...]

    def frame(self, number: int) -> Frame:
        """One of the frames, float32."""
        return _render(self, number)


SHOTS = {
    # Small enough for the reference implementations. It moves along both axes: with a motion of zero along one of them,
    # rounding would decide on which side a pixel has a neighbour.
    "moving": Shot((72, 104), 1.2, (0.03, 0.017), 3, (0, 1, 2)),
    # Large enough for the compiled forms, and wide enough for a network to run on a part of it. At first nothing is
    # skipped but what has no noise; then tiles of little noise are passed through; then those without noise are
    # reused.
    "still": Shot((40, 304), 0.5, (0.0, 0.0), 20, (0, 9, 19)),
}


def _triangle(x: Tensor) -> Tensor:
    return 2 * (x - torch.floor(x) - 0.5).abs()


def _point(*coordinates: float) -> Tensor:
    return torch.tensor(coordinates, dtype=torch.float64).reshape(3, 1, 1)


def _sphere(ray: Tensor, eye: Tensor, center: Tensor, radius: float) -> Tensor:
    """Distance along a ray, infinite where it passes by."""
    to = center - eye
    along, length = (ray * to).sum(0), (ray * ray).sum(0)
    root = along.square() - length * (to.square().sum() - radius**2)
    return torch.where(root > 0, (along - root.clamp_min(0).sqrt()) / length, torch.inf)


def _render(shot: Shot, number: int) -> Frame:
    """A floor, a wall with a lamp, two spheres, one without albedo, and a background above the wall."""
    height, width = shot.size
    eye = _point(shot.step[0] * number, shot.step[1] * number, 0)
    rows = torch.arange(height, dtype=torch.float64)[:, None].expand(height, width)
    columns = torch.arange(width, dtype=torch.float64)[None].expand(height, width)
    focal_y = shot.focal * width / height
    across, down = ((2 * columns + 1) / width - 1) / shot.focal, ((2 * rows + 1) / height - 1) / focal_y
    ray = torch.stack([across, down, torch.ones_like(down)])
    spheres = (_point(0.6, 0.3, 4.0), 0.7), (_point(2.2, 0.5, 5.0), 0.5)
    floor = torch.where(down > 0, (1 - eye[1]) / down.clamp_min(1e-3), torch.inf)
    wall = torch.where(eye[1] + down * 6 > -1.2, 6.0, torch.inf)
    distances = torch.stack([floor, wall, *(_sphere(ray, eye, *sphere) for sphere in spheres)])
    depth, kind = distances.min(0)
    hit = depth.isfinite()
    position = eye + ray * torch.where(hit, depth, 1000.0)
    x, y, z = position
    normal = torch.zeros_like(position)
    normal[1] = torch.where(hit & (kind == 0), -1.0, 0.0)
    normal[2] = torch.where(hit & (kind == 1), -1.0, 0.0)
    for index, (center, radius) in enumerate(spheres):
        normal = torch.where(hit & (kind == 2 + index), (position - center) / radius, normal)
    lamp = hit & (kind == 1) & ((x + 1.3).abs() < 0.6) & ((y + 0.6).abs() < 0.35)
    mirror = hit & (kind == 3)
    pattern = torch.stack([_triangle(1.3 * x + 0.2), _triangle(1.7 * y + 0.5 * z), _triangle(0.9 * (x + z))])
    albedo = torch.where(hit & ~lamp & ~mirror, 0.2 + 0.6 * pattern, 0.0)
    falloff = 1 / (1 + 0.1 * ((x + 1.3).square() + (y + 0.6).square() + (z - 6).square()))
    warm = _point(1.1, 1.0, 0.9)
    irradiance = (0.7 + 0.6 * falloff) * warm
    parity = (rows + columns) % 2
    radiance = torch.where(mirror, 0.5 + parity, albedo * irradiance)
    radiance = torch.where(lamp, 12 * warm, radiance)
    radiance = torch.where(hit, radiance, 0.6 + 0.1 * rows / height + 0 * warm)
    color = radiance * _noise(shot, number, hit & ~lamp)
    matrix = torch.zeros(4, 4, dtype=torch.float64)
    matrix[0, 0], matrix[1, 1], matrix[2, 2], matrix[2, 3] = shot.focal, focal_y, 1, 1
    matrix[3, 0], matrix[3, 1], matrix[3, 2] = -shot.focal * eye[0], -focal_y * eye[1], -0.1
    buffers = {"color": color, "albedo": albedo, "normal": normal, "depth": depth[None], "position": position}
    return Frame(**{name: value[None].float() for name, value in (*buffers.items(), ("view_projection", matrix))})


def _noise(shot: Shot, number: int, noisy: Tensor) -> Tensor:
    """Factors of mean one: of a path tracer, with a few fireflies; in the still shot of less and less to the right."""
    height, width = shot.size
    drawn = torch.rand(4, height, width, generator=torch.Generator().manual_seed(100 + number)).double()
    strong = (0.15 + 2.55 * drawn[:1].square()) * (0.8 + 0.4 * drawn[1:])
    columns = torch.arange(width)
    if any(shot.step):
        factor = strong
    else:
        weak = torch.where(columns < 224, 1 + 0.001 * (2 * drawn[1:] - 1), 1.0)
        factor = torch.where(columns < 64, strong, weak)
    for row, column in ((height - 9, 7), (height - 20, 41)):
        factor[:, row, column] = 80.0
    return torch.where(noisy, factor, 1.0)


def kept_pixels(image: Tensor) -> Tensor:
    """What the file has of an image, ``(3, h, w)``."""
    return image[0, :, ::STRIDE, ::STRIDE]


def change(found: Tensor, expected: Tensor) -> dict[str, float]:
    """How far an image is from another: relative where that is bright, and of half its mean where it is dark."""
    unit = expected.double() + expected.double().mean() / 2
    relative = (found.double() - expected.double()).abs() / unit
    return {"largest": float(relative.max()), "rms": float(relative.square().mean().sqrt())}


def golden() -> tuple[dict[str, Tensor], dict[str, list[dict[str, float]]]]:
    """The images by ``shot.model.frame``, and how far they move by ``shot.model.precision``, for each frame."""
    with safe_open(FILE, framework="pt") as file:
        images = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - a safetensors handle is no dict
        return images, json.loads(file.metadata()["responses"])
