"""Two small shots that are equal on every machine.

The shots are computed with arithmetic and uniform random numbers in float64, and rounded to float32 at the end. If a
machine rounds differently, inputs change by a unit roundoff, for which the bounds account.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from mcdenoise import Frame


@dataclass(frozen=True)
class Shot:
    """A shot.

    Args:
        name: its name.
        size: height and width.
        focal: width of the image plane at distance 1 is 2 / focal.
        eyes: position of the camera in each frame in scene units, to the right and down.
        kept: what the kept frames show, by their number.
        fades: whether the noise decreases to the right, to none.
    """

    name: str
    size: tuple[int, int]
    focal: float
    eyes: tuple[tuple[float, float], ...]
    kept: dict[int, str]
    fades: bool = False

    def frames(self) -> list[Frame]:
        """All frames, in float32, with every buffer that a method of the zoo uses, two layers and alpha."""
        return [_render(self, number) for number in range(len(self.eyes))]


# Small enough for the reference implementations, and large enough for two tiles. The camera moves along both axes: if
# the motion along one axis were zero up to rounding, rounding would decide on which side a pixel has a neighbour.
MOVING = Shot(
    "moving",
    (40, 96),
    1.0,
    ((0.0, 0.0), (0.03, 0.017), (0.03, 0.017), (0.03, 0.017), (2.4, -0.9)),
    {0: "first", 1: "moving", 3: "still", 4: "cut"},
)
# Large enough for the compiled backends, and wide enough for a network to run on a part of it. At first only pixels
# without noise are skipped; then tiles of little noise are passed through; then unchanged tiles are reused.
STILL = Shot("still", (40, 304), 0.5, ((0.0, 0.0),) * 20, {0: "first", 9: "passed", 19: "reused"}, fades=True)


def _triangle(x: Tensor) -> Tensor:
    return 2 * (x - torch.floor(x) - 0.5).abs()


def _point(*coordinates: float) -> Tensor:
    return torch.tensor(coordinates, dtype=torch.float64).reshape(3, 1, 1)


def _sphere(ray: Tensor, eye: Tensor, center: Tensor, radius: float) -> Tensor:
    """Distance to a sphere along a ray, infinite for rays that miss it."""
    to = center - eye
    along, length = (ray * to).sum(0), (ray * ray).sum(0)
    root = along.square() - length * (to.square().sum() - radius**2)
    return torch.where(root > 0, (along - root.clamp_min(0).sqrt()) / length, torch.inf)


def _render(shot: Shot, number: int) -> Frame:
    """A floor, a wall with a lamp, two spheres, one without albedo, and a background above the wall."""
    height, width = shot.size
    eye = _point(*shot.eyes[number], 0)
    rows = torch.arange(height, dtype=torch.float64)[:, None].expand(height, width)
    columns = torch.arange(width, dtype=torch.float64)[None].expand(height, width)
    focal_y = shot.focal * width / height
    across, down = ((2 * columns + 1) / width - 1) / shot.focal, ((2 * rows + 1) / height - 1) / focal_y
    ray = torch.stack([across, down, torch.ones_like(down)])
    spheres = (_point(0.6, 0.3, 4.0), 0.7), (_point(2.2, 0.5, 5.0), 0.5)
    floor = torch.where(down > 0, (1 - eye[1]) / down.clamp_min(1e-3), torch.inf)
    wall = torch.where(eye[1] + down * 6 > -2.2, 6.0, torch.inf)
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
    paint = torch.where(kind == 1, _point(0.5, 0.6, 0.4), 0.2 + 0.6 * pattern)
    albedo = torch.where(hit & ~lamp & ~mirror, paint, 0.0)
    falloff = 1 / (1 + 0.1 * ((x + 1.3).square() + (y + 0.6).square() + (z - 6).square()))
    warm = _point(1.1, 1.0, 0.9)
    irradiance = (0.7 + 0.6 * falloff) * warm
    specular = torch.where(mirror, 0.5 + (rows + columns) % 2, 0.0).expand(3, height, width)
    emission = torch.where(lamp, 12 * warm, 0.0)
    background = torch.where(hit, 0.0, 0.6 + 0.1 * rows / height + 0 * warm)
    if not shot.fades:
        albedo, normal, depth, position, background = _uneven(number, albedo, normal, depth, position, background)
    noise = torch.stack([_noise(shot, number, sample, hit & ~lamp) for sample in range(2)])
    samples = (albedo * irradiance + specular) * noise + emission + background
    reference = albedo * irradiance + specular + emission + background
    diffuse, specular = albedo * irradiance * noise.mean(0), specular * noise.mean(0)
    matrix = torch.zeros(4, 4, dtype=torch.float64)
    matrix[0, 0], matrix[1, 1], matrix[2, 2], matrix[2, 3] = shot.focal, focal_y, 1, 1
    matrix[3, 0], matrix[3, 1], matrix[3, 2] = -shot.focal * eye[0], -focal_y * eye[1], -0.1
    images = {
        "color": samples.mean(0),
        "albedo": albedo,
        "normal": normal,
        "depth": depth[None],
        "position": position,
        "diffuse": diffuse,
        "specular": specular,
        "emission": emission,
        "roughness": torch.where(mirror, 0.0, 0.5 + 0.5 * pattern[:1]),
        "alpha": torch.where(hit, 0.6 + 0.4 * pattern[:1] * noise.mean(0)[:1].clamp_max(1), 0.0),
        "samples": samples,
        "reference": reference,
        "view_projection": matrix,
    }
    layers = {"diffuse": diffuse, "specular": specular, "light": emission + background}
    return Frame(
        **{name: image[None].float() for name, image in images.items()},
        extra={"gradient": 0.2 * samples.diff(dim=0).float()},
        layers={name: layer[None].float() for name, layer in layers.items()},
    )


def _uneven(number: int, *images: Tensor) -> list[Tensor]:
    """Images with a little noise: between equal numbers, and for planes, rounding would decide too much."""
    generator = torch.Generator().manual_seed(number)
    return [image * (1 - 0.003 * torch.rand(image.shape, generator=generator).double()) for image in images]


def _noise(shot: Shot, number: int, sample: int, noisy: Tensor) -> Tensor:
    """Noise factors like those of a path tracer, with two fireflies."""
    height, width = shot.size
    generator = torch.Generator().manual_seed(100 + 50 * sample + number)
    drawn = torch.rand(4, height, width, generator=generator).double()
    factor = (0.03 + 6.79 * drawn[:1].pow(6)) * (0.8 + 0.4 * drawn[1:])
    columns = torch.arange(width)
    if shot.fades:
        weak = torch.where(columns < 224, 1 + 0.001 * (2 * drawn[1:] - 1), 1.0)
        factor = torch.where(columns < 64, factor, weak)
    for row, column in ((height - 9, 7), (height - 20, 41)):
        factor[:, row, column] = 80.0
    return torch.where(noisy, factor, 1.0)
