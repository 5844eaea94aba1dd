"""Rows of the ops on images of one frame: resolutions, albedo, grids, fireflies, edges, regression."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Generator, Tensor

from mcdenoise import ops
from mcdenoise.check.case import Draw, Op, between, constant, dim, normal, numbers, powers, radiance, times, uniform
from mcdenoise.check.regimes import HALF, IMAGE, IMAGES, SMALL, Argument, Size, checked, extreme, ordinary, stiff
from mcdenoise.ops._window import parts_of

_POSITIVE = {name: draw for name, draw in IMAGES.items() if "signs" not in name}
_FUSION = checked(
    ops.laplacian_fusion,
    {"fine": IMAGE, "coarse": HALF, "alpha": Argument(uniform, 1, numbers(0, 1))},
    ordinary("an alpha for each channel", (1, 3, 3, 2), alpha=3),
)


def _half_zero(g: Generator, *shape: int) -> Tensor:
    """Every other column has no albedo, and no pixel has red."""
    values = uniform(g, *shape, low=0.05)
    values[..., ::2], values[:, 0] = 0, 0
    return values


def _around(value: float, draw: Draw) -> Draw:
    """Numbers on both sides of a limit, that far from it relatively."""
    return lambda g, *shape: value * (1 + draw(g, *shape) * torch.sign(normal(g, *shape)))


def _demodulation(function: Any, name: str) -> Op:
    # Below 1e-4 a pixel counts as untextured.
    limits = numbers(0, 1e-8, 1e-4, 5, 1e4) | {"about 1e-4": _around(1e-4, between(2**-12, 2**-6))}
    return checked(
        function,
        {name: IMAGE, "albedo": Argument(between(0.05, 1), limits=limits)},
        ordinary("floor 0.5", (1, 3, 1, 2), uniform, floor=0.5),
        ordinary("no albedo in every other column", (1, 3, 2, 5), uniform, albedo=_half_zero),
        # 5e-4 away from the kink at the floor of 0.04.
        extreme("albedo near the floor", (1, 3, 3, 3), smooth=(name, "albedo"), albedo=_around(0.04, constant(0.0125))),
        image=uniform,
    )


def sparks(draw: Draw, value: float, *places: tuple[int, int]) -> Draw:
    """An image with so bright pixels at some places."""

    def drawn(g: Generator, *shape: int) -> Tensor:
        image = draw(g, *shape)
        for row, column in places:
            image[..., row, column] = value
        return image

    return drawn


def _half_range(g: Generator, *shape: int) -> Tensor:
    """Pixels so bright that a sum of three channels overflows, beside the smallest normal number."""
    drawn = uniform(g, *shape, low=5e4, high=6.5e4)
    drawn[..., ::2] = torch.finfo(torch.float16).tiny
    return drawn


_THREE = ((1, 1), (1, 2), (2, 1))
_FIREFLIES = checked(
    ops.clamp_fireflies,
    {"image": IMAGE},
    stiff("fireflies side by side", (1, 3, 4, 5), sparks(uniform, 1e4, *_THREE), limit=2.0),
    # Black neighbours are excluded from the mean; this jumps at zero, so there is no derivative.
    extreme("fireflies on black", (1, 3, 4, 5), sparks(constant(0), 1e4, *_THREE), limit=1.5),
    extreme("1e30 beside 1e-4", (1, 3, 3, 5), sparks(constant(1e-4), 1e30, (1, 4))),
    extreme("range of half precision", (1, 3, 3, 5), _half_range, ("image",), limit=1.1),
    *(extreme(f"limit {limit:g}", limit=limit) for limit in (1e-6, 1e30)),
    # Small windows have low limits, so that they clamp some pixels too.
    settings={"limit": (2.0, 1.5, 1.2, 2.0), "kernel_size": (7, 3, 5, 7)},
    image=uniform,
    limits=_POSITIVE,
    fireflies=stiff("fireflies of 100", (1, 3, 3, 4), radiance, limit=2.0),
)


def _between_centres(g: Generator, *shape: int) -> Tensor:
    """Guides away from the centres of one to four bins, where derivatives jump."""
    places = torch.tensor([0.06, 0.2, 0.31, 0.44, 0.56, 0.69, 0.8, 0.94], dtype=torch.float64)
    return places[torch.randint(len(places), shape, generator=g)] + uniform(g, *shape, low=-0.02, high=0.02)


def _two(g: Generator, *shape: int) -> Tensor:
    return (uniform(g, *shape) > 0.5).double()


def _cells(size: Size, settings: Mapping[str, Any]) -> tuple[int, ...]:
    return parts_of(size[2], settings["cell"]), parts_of(size[3], settings["cell"]), 4


def _guide_rounds(inputs: dict[str, Any], settings: dict[str, Any]) -> dict[str, Tensor]:
    """The coordinate of a guide, and the height of a tent, are rounded like a guide of 1."""
    return {"guide": inputs["guide"].abs().clamp_min(1)}


_GUIDE = Argument(_between_centres, 1, numbers(0, 1) | {"0 or 1": _two, "beyond the range": times(6, uniform, -2)})
# Finite differences in the guide of a firefly are too inaccurate for the dark pixels beside it.
_SPLAT = checked(
    ops.grid_splat,
    {"image": IMAGE, "guide": _GUIDE},
    # At bin centres the tents of the neighbouring bins end.
    extreme("guide at the centres of bins", (1, 1, 2, 3), guide=_two, cell=2, bins=256),
    settings={"cell": (2, 4, 3, 1, 2), "bins": (2, 2, 4, 3, 1)},
    sizes=SMALL,
    fireflies=stiff("fireflies", (1, 1, 2, 3), dim, cell=2, bins=2),
    rounds=_guide_rounds,
)
_FILLED = {"1e-3": constant(1e-3), "0": constant(0), "0 or 1": _two}
_SLICE = checked(
    ops.grid_slice,
    {"grid": replace(IMAGE, axes=_cells), "filled": Argument(between(0.2, 1), 1, _FILLED, _cells), "guide": _GUIDE},
    # Where all cells around a pixel are empty, the result jumps once one of them is filled.
    extreme("empty cells", (1, 3, 3, 5), normal, ("grid",), filled=_two, cell=2),
    settings={"cell": (2, 4, 3, 1)},
    sizes=SMALL,
    fireflies=stiff("fireflies", (1, 1, 2, 3), dim, cell=2),
    rounds=_guide_rounds,
)


def _rough(g: Generator, *shape: int) -> Tensor:
    """Normals of a rough surface, for which the weights of taps are neither 0 nor 1."""
    facing = torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64).reshape(1, 3, 1, 1)
    return F.normalize(facing + 0.05 * normal(g, *shape))


def sky(drawn: dict[str, Any]) -> None:
    """Nothing is hit in the first row."""
    drawn["depth"][..., 0, :], drawn["normal"][..., 0, :] = torch.inf, 0


# Normals and depths of a wall.
WALL = {
    "normal": Argument(_rough, 3, numbers(0)),
    "depth": Argument(between(4, 5), 1, numbers(0, 1e-30, 1e30, math.inf) | {"of forty decades": powers(-30, 10)}),
}


def noise(low: float, high: float, *limits: float) -> Argument:
    """Standard deviations as parts of the light, of which :func:`proportional` makes variances."""
    return Argument(between(low, high), 1, numbers(*limits))


def proportional(light: str) -> Any:
    """The standard deviation is proportional to the light, like that of a sample."""

    def relate(inputs: dict[str, Any], settings: Mapping[str, Any]) -> None:
        mean = inputs[light].abs().mean(1, keepdim=True)
        inputs["variance"] = (inputs["variance"] * mean).square().clamp_max(1e34)

    return relate


def _corner(drawn: dict[str, Any]) -> None:
    facing = torch.tensor([0.8, 0.0, 0.6], dtype=torch.float64).reshape(3, 1, 1)
    drawn["normal"][..., 2:], drawn["depth"][..., 2:] = facing, 9


_FOUR = (1, 1, 1, 4)
_ATROUS = checked(
    ops.atrous,
    {"light": Argument(channels=3), "variance": noise(0.15, 0.3, 0, 1e15), **WALL},
    stiff("little noise", (1, 3, 1, 3), times(100, uniform), variance=between(0.01, 0.02)),
    stiff("an edge", _FOUR, uniform, ("light", "variance"), change=_corner),
    # Infinity has no finite difference.
    extreme("sky", (1, 3, 2, 2), uniform, ("light", "variance", "normal"), change=sky),
    settings={"step": (1, 1, 2, 64), "only": (None, "light variance", "light variance normal")},
    sizes=SMALL,
    image=uniform,
    # The step of finite differences is too coarse for deviations of 1e-4 beside deviations of 1e2.
    fireflies=stiff("fireflies", _FOUR, dim, ("normal", "depth")),
    relate=proportional("light"),
)


def _second_moments(inputs: dict[str, Any], settings: Mapping[str, Any]) -> None:
    mean = inputs["moments"][:, :1]
    inputs["moments"] = torch.cat([mean, mean.square() * (1 + inputs.pop("spread"))], 1)


_SPREAD = Argument(between(0.5, 1), 1, numbers(0))
_VARIANCE = checked(
    ops.moments_variance,
    {"moments": Argument(channels=1), "spread": _SPREAD, **WALL},
    stiff("moments that cancel", (1, 1, 3, 3), uniform, only="moments", spread=between(5e-4, 1e-3)),
    settings={"kernel_size": (3, 1, 5, 7), "sigma_z": (1.0, 3.0), "only": (None, "moments", None, "moments")},
    sizes=SMALL,
    image=uniform,
    fireflies=stiff("fireflies", (1, 1, 2, 3), dim, kernel_size=3),
    relate=_second_moments,
)


def _dependent(g: Generator, *shape: int) -> Tensor:
    """Two constant features, and two of which one is twice the other."""
    rest = uniform(g, shape[0], 1, *shape[2:])
    return torch.cat([torch.full_like(rest, -0.8), rest, 2 * rest, torch.zeros_like(rest)], 1)


def _nearly(g: Generator, *shape: int) -> Tensor:
    """Features that differ by a thousandth."""
    return normal(g, shape[0], 1, *shape[2:]) + 1e-3 * normal(g, *shape)


_BLOCK = (1, 1, 4, 4)
_OF_IMAGE: Any = {"smooth": ("image",), "block": 4}
_REGRESSION = checked(
    ops.block_regression,
    {"image": IMAGE, "features": Argument(normal, 2)},
    ordinary("a square", _BLOCK, block=4, squares=1),
    ordinary("blocks of 3, a large ridge", (1, 2, 4, 3), block=3, ridge=0.1, squares=2, offset=(1, 2)),
    stiff("features that differ by a thousandth", _BLOCK, features=_nearly, **_OF_IMAGE),
    stiff("millimetres", _BLOCK, features=[3, between(5e3, 6e3)], squares=3, **_OF_IMAGE),
    # Finite differences are too inaccurate for dependent features, and for features with a large mean.
    extreme("a flat wall", (1, 1, 4, 5), normal, features=_dependent, squares=1, **_OF_IMAGE),
    extreme("positions of 1e6", _BLOCK, normal, features=between(1e6, 1e6 + 1), squares=2, **_OF_IMAGE),
    extreme("more features than pixels", (1, 1, 2, 2), normal, features=5, squares=2, **_OF_IMAGE),
    # No squares: a feature that is nearly all in one pixel is proportional to its square.
    *(extreme(f"features {name}", features=draw, block=3, offset=(1, 2)) for name, draw in IMAGES.items()),
    settings={"block": (3,), "offset": ((1, 2),), "squares": (1,)},
    fireflies=stiff("fireflies", _BLOCK, radiance, **_OF_IMAGE),
    smooth=("image",),
)

OPS = (
    checked(ops.downsample, {"image": IMAGE}),
    checked(ops.upsample, {"image": HALF}),
    _FUSION,
    _demodulation(ops.demodulate, "color"),
    _demodulation(ops.remodulate, "image"),
    _SPLAT,
    _SLICE,
    _FIREFLIES,
    _ATROUS,
    checked(ops.luminance_moments, {"light": Argument(channels=3)}, image=uniform),
    _VARIANCE,
    _REGRESSION,
)
