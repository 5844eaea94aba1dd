"""Builders and rows of the ops on images of one frame: resolutions, albedo, grids, fireflies, edges, regression."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Generator, Tensor

from mcdenoise import ops
from mcdenoise.check.case import Draw, Inputs, Op, between, constant, dim, normal, radiance, times, uniform
from mcdenoise.check.regimes import IMAGES, SMALL, Size, checked, extreme, ordinary, stiff
from mcdenoise.ops._grid import cells_of

_IMAGE = ("image",)


def _half(size: Size) -> Size:
    return *size[:2], (size[2] + 1) // 2, (size[3] + 1) // 2


def _image(g: Generator, size: Size, image: Draw) -> Inputs:
    return {"image": image(g, *size)}


def _halved(g: Generator, size: Size, image: Draw) -> Inputs:
    return {"image": image(g, *_half(size))}


def _fused(g: Generator, size: Size, image: Draw, alpha: Draw = uniform, alphas: int = 1) -> Inputs:
    fine, coarse = image(g, *size), image(g, *_half(size))
    return {"fine": fine, "coarse": coarse, "alpha": alpha(g, size[0], alphas, *size[2:])}


_FUSION = checked(
    ops.laplacian_fusion,
    _fused,
    ordinary("an alpha for each channel", (1, 3, 3, 2), alphas=3),
    *(extreme(f"alpha {value}", alpha=constant(value)) for value in (0, 1)),
    images=("fine", "coarse"),
)


def _demodulation(function: Any) -> Op:
    name = "color" if function is ops.demodulate else "image"

    def build(g: Generator, size: Size, image: Draw, albedo: Draw = between(0.05, 1)) -> Inputs:
        return {name: image(g, *size), "albedo": albedo(g, *size)}

    def half_zero(g: Generator, *shape: int) -> Tensor:
        """Every other column has no albedo, and no pixel has red."""
        values = uniform(g, *shape, low=0.05)
        values[..., ::2], values[:, 0] = 0, 0
        return values

    def near_floor(g: Generator, *shape: int) -> Tensor:
        """5e-4 away from the kink at the floor of 0.04, on both sides."""
        return 0.04 + 5e-4 * torch.sign(normal(g, *shape))

    def barely(g: Generator, *shape: int) -> Tensor:
        """Half-precision albedos on both sides of the threshold below which a pixel counts as untextured."""
        return 1e-4 * (1 + 2.0 ** -uniform(g, *shape, low=6, high=12) * torch.sign(normal(g, *shape)))

    return checked(
        function,
        build,
        ordinary("floor 0.5", (1, 3, 1, 2), uniform, floor=0.5),
        ordinary("no albedo in every other column", (1, 3, 2, 5), uniform, albedo=half_zero),
        extreme("fireflies, albedo near the floor", (1, 3, 3, 3), smooth=(name, "albedo"), albedo=near_floor),
        *(extreme(f"albedo {value:g}", albedo=constant(value)) for value in (0, 1e-8, 1e-4, 5, 1e4)),
        extreme("albedo about 1e-4", (1, 3, 5, 7), albedo=barely),
        image=uniform,
        images=(name,),
    )


def _clamped(g: Generator, size: Size, image: Draw, fireflies: Any = (), value: float = 1e4) -> Inputs:
    drawn = image(g, *size)
    for row, column in fireflies:
        drawn[..., row, column] = value
    return {"image": drawn}


def _sparse(g: Generator, *shape: int) -> Tensor:
    drawn = torch.zeros(shape, dtype=torch.float64)
    drawn[..., ::2, ::3] = uniform(g, *drawn[..., ::2, ::3].shape)
    drawn[..., 0, 0] *= 9
    return drawn


def _half_range(g: Generator, *shape: int) -> Tensor:
    """Pixels so bright that a sum of three channels overflows, beside the smallest normal number."""
    drawn = uniform(g, *shape, low=5e4, high=6.5e4)
    drawn[..., ::2] = torch.finfo(torch.float16).tiny
    return drawn


_FIREFLIES = checked(
    ops.clamp_fireflies,
    _clamped,
    ordinary("5x7, one firefly", (1, 1, 5, 7), uniform, fireflies=[(2, 3)]),
    ordinary("constant", (1, 3, 3, 4), constant(0.3)),
    *(
        stiff(f"fireflies at {at}", (1, 3, 4, 5), uniform, fireflies=at, limit=2.0)
        for at in ([(0, 0)], [(3, 2)], [(1, 1), (1, 2), (2, 1)])
    ),
    # Black neighbours are excluded from the mean; this jumps at zero, so there is no derivative.
    extreme("one bright pixel on black", image=constant(0), fireflies=[(1, 1)]),
    extreme("one pixel in five lit", (1, 3, 3, 5), _sparse, limit=1.5),
    extreme("1e30 beside 1e-4", (1, 3, 3, 5), constant(1e-4), fireflies=[(1, 4)], value=1e30),
    extreme("range of half precision", (1, 3, 3, 5), _half_range, ("image",), limit=1.1),
    *(extreme(f"limit {limit:g}", limit=limit) for limit in (1e-6, 1e30)),
    # Small windows have low limits, so that they clamp some pixels too.
    settings=({"limit": 2.0}, {"limit": 1.5, "kernel_size": 3}, {"limit": 1.2, "kernel_size": 5}, {"limit": 2.0}),
    image=uniform,
    limits={name: draw for name, draw in IMAGES.items() if "signs" not in name},
    fireflies=stiff("fireflies of 100", (1, 3, 3, 4), radiance, limit=2.0),
    images=_IMAGE,
)


def _guide(g: Generator, batch: int, _: int, height: int, width: int, bins: int) -> Tensor:
    """Guides between the centres of bins, or beyond the first and the last, but not near them."""
    shape = (batch, 1, height, width)
    drawn = torch.randint(bins + 1, shape, generator=g) - 0.5 + uniform(g, *shape, low=0.15, high=0.85)
    return (drawn.clamp(0.02 * bins, 0.98 * bins) * 256 / bins - 0.5) / 255


def _splatted(g: Generator, size: Size, image: Draw, guide: Draw | None = None, bins: int = 4) -> Inputs:
    drawn = image(g, *size)
    where = size[0], 1, *size[2:]
    return {"image": drawn, "guide": _guide(g, *where, bins=bins) if guide is None else guide(g, *where)}


def _sliced(
    g: Generator,
    size: Size,
    image: Draw,
    guide: Draw | None = None,
    filled: Draw = between(0.2, 1),
    cell: int = 2,
    bins: int = 4,
) -> Inputs:
    cells = size[0], size[1], cells_of(size[2], cell), cells_of(size[3], cell)
    # An image over the rows and columns of cells.
    grid = image(g, *cells)[..., None] * uniform(g, size[0], 1, *cells[2:], bins, low=0.5)
    known = filled(g, size[0], 1, *cells[2:], bins)
    return {"grid": grid, "filled": known, "guide": _splatted(g, size, constant(0), guide, bins)["guide"]}


def _two(g: Generator, *shape: int) -> Tensor:
    return (uniform(g, *shape) > 0.5).double()


_GUIDES = {"0": constant(0), "1": constant(1), "0 or 1": _two, "beyond the range": times(6, uniform, -2)}
_CELLS = (
    {"cell": 2, "bins": 2},
    {"cell": 4, "bins": 2},
    {"cell": 3, "bins": 4},
    {"cell": 1, "bins": 3},
    {"cell": 2, "bins": 1},
)


def _guide_rounds(inputs: dict[str, Any], settings: dict[str, Any]) -> dict[str, Tensor]:
    """The coordinate of a guide, and the height of a tent, are rounded like a guide of 1."""
    return {"guide": inputs["guide"].abs().clamp_min(1)}


# Finite differences in the guide of a firefly are too inaccurate for the dark pixels beside it.
_SPLAT = checked(
    ops.grid_splat,
    _splatted,
    extreme("bright fireflies", (1, 3, 3, 3), smooth=("image",), cell=2, bins=2),
    *(extreme(f"guide {name}", guide=draw, cell=2, bins=4) for name, draw in _GUIDES.items()),
    # At bin centres the tents of the neighbouring bins end.
    extreme("guide at the centres of bins", (1, 1, 2, 3), guide=_two, cell=2, bins=256),
    settings=_CELLS,
    sizes=SMALL,
    fireflies=stiff("fireflies", (1, 1, 2, 3), dim, cell=2, bins=2),
    images=_IMAGE,
    rounds=_guide_rounds,
)
_SLICE = checked(
    ops.grid_slice,
    _sliced,
    ordinary("all filled", (1, 2, 2, 3), smooth=("grid",), filled=constant(1), cell=2, bins=1),
    extreme("bright fireflies", (1, 3, 3, 3), smooth=("grid",), cell=2, bins=2),
    # Where all cells around a pixel are empty, the result jumps once one of them is filled.
    extreme("empty cells", (1, 3, 3, 5), normal, ("grid",), filled=_two, cell=2),
    extreme("no cell is filled", (1, 1, 2, 2), normal, ("grid",), filled=constant(0), cell=2),
    *(extreme(f"guide {name}", guide=draw, filled=_two, cell=2) for name, draw in _GUIDES.items()),
    extreme("cells of weight 1e-3", filled=constant(1e-3), cell=2),
    settings=_CELLS,
    sizes=SMALL,
    fireflies=stiff("fireflies", (1, 1, 2, 3), dim, cell=2, bins=2),
    images=("grid",),
    rounds=_guide_rounds,
)


def wall(g: Generator, size: Size) -> dict[str, Tensor]:
    """Normals and depths of a rough surface, for which the weights of taps are neither 0 nor 1."""
    toward = torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64).reshape(1, 3, 1, 1)
    facing = toward + 0.05 * normal(g, size[0], 3, *size[2:])
    depth = uniform(g, size[0], 1, *size[2:], low=4, high=5)
    return {"normal": facing / facing.norm(dim=1, keepdim=True), "depth": depth}


def sky(drawn: Inputs) -> None:
    """Nothing is hit in the first row."""
    drawn["depth"][..., 0, :] = torch.inf  # type: ignore[index, call-overload]
    drawn["normal"][..., 0, :] = 0  # type: ignore[index, call-overload]


def seen(drawn: Inputs, inputs: tuple[str, ...] | None, change: Any, depth: Draw | None, g: Generator) -> Inputs:
    """The drawn images, changed, those of these names."""
    if depth is not None:
        drawn["depth"] = depth(g, *drawn["depth"].shape)  # type: ignore[union-attr]
    if change is not None:
        change(drawn)
    return drawn if inputs is None else {name: drawn[name] for name in inputs}


def _lit(
    g: Generator,
    size: Size,
    image: Draw,
    inputs: tuple[str, ...] | None = None,
    noise: float = 0.3,
    change: Any = None,
    depth: Draw | None = None,
) -> Inputs:
    light = image(g, size[0], 3, *size[2:])
    # A standard deviation proportional to the mean, like that of a sample.
    spread = noise * uniform(g, size[0], 1, *size[2:], low=0.5) * light.abs().mean(1, keepdim=True)
    drawn: Inputs = {"light": light, "variance": spread.square().clamp_max(1e34), **wall(g, size)}
    return seen(drawn, inputs, change, depth, g)


def _corner(drawn: Inputs) -> None:
    facing = torch.tensor([0.8, 0.0, 0.6], dtype=torch.float64).reshape(3, 1, 1)
    drawn["normal"][..., 2:], drawn["depth"][..., 2:] = facing, 9  # type: ignore[index, call-overload]


_FOUR = (1, 1, 1, 4)
_FAR = (0.0, 1e-30, 1e30, math.inf)
_ATROUS = checked(
    ops.atrous,
    _lit,
    ordinary("light alone", (1, 3, 2, 2), uniform, inputs=("light", "variance")),
    ordinary("normals", _FOUR, uniform, inputs=("light", "variance", "normal")),
    ordinary("taps 2 pixels apart", _FOUR, uniform, step=2),
    stiff("little noise", (1, 3, 1, 3), times(100, uniform), noise=0.02),
    stiff("an edge", _FOUR, uniform, ("light", "variance"), change=_corner),
    # Infinity has no finite difference.
    extreme("sky", (1, 3, 2, 2), uniform, ("light", "variance", "normal"), change=sky),
    # Central differences would need a negative variance.
    extreme("no noise", (1, 3, 1, 3), uniform, ("light", "normal", "depth"), noise=0.0),
    extreme("taps 64 pixels apart", step=64),
    *(extreme(f"noise of {noise:g} times the light", noise=noise) for noise in (0, 1e15)),
    *(extreme(f"depth {value:g}", depth=constant(value)) for value in _FAR),
    extreme("depths of forty decades", depth=IMAGES["forty decades"]),
    extreme("no normals", change=lambda drawn: drawn["normal"].zero_()),
    sizes=SMALL,
    image=uniform,
    # The step of finite differences is too coarse for deviations of 1e-4 beside deviations of 1e2.
    fireflies=stiff("fireflies", _FOUR, dim, ("normal", "depth")),
)


def _light(g: Generator, size: Size, image: Draw) -> Inputs:
    return {"light": image(g, size[0], 3, *size[2:])}


def _moments(
    g: Generator, size: Size, image: Draw, inputs: tuple[str, ...] | None = None, spread: float = 1.0
) -> Inputs:
    mean = image(g, size[0], 1, *size[2:])
    more = spread * uniform(g, size[0], 1, *size[2:], low=0.5)
    drawn: Inputs = {"moments": torch.cat([mean, mean.square() * (1 + more)], 1), **wall(g, size)}
    return seen(drawn, inputs, None, None, g)


_VARIANCE = checked(
    ops.moments_variance,
    _moments,
    ordinary("the pixel alone", (1, 1, 3, 4), uniform, inputs=("moments",)),
    ordinary("moments alone", (1, 1, 2, 5), uniform, inputs=("moments",), kernel_size=3),
    stiff("moments that cancel", (1, 1, 3, 3), uniform, inputs=("moments",), spread=1e-3),
    extreme("moments that cancel altogether", (1, 3, 3, 5), spread=0.0),
    settings=(
        {"kernel_size": 3},
        {"kernel_size": 7},
        {"kernel_size": 5, "sigma_z": 3.0, "sigma_n": 8.0},
        {"kernel_size": 7},
    ),
    sizes=SMALL,
    image=uniform,
    fireflies=stiff("fireflies", (1, 1, 2, 3), dim, kernel_size=3),
)


def _regressed(g: Generator, size: Size, image: Draw, features: Draw = normal, count: int = 2) -> Inputs:
    return {"image": image(g, *size), "features": features(g, size[0], count, *size[2:])}


def _dependent(g: Generator, *shape: int) -> Tensor:
    """Two constant features, and two of which one is twice the other."""
    rest = uniform(g, shape[0], 1, *shape[2:])
    return torch.cat([torch.full_like(rest, -0.8), rest, 2 * rest, torch.zeros_like(rest)], 1)


def _nearly(g: Generator, *shape: int) -> Tensor:
    """Two features that differ by a thousandth."""
    first = normal(g, shape[0], 1, *shape[2:])
    return torch.cat([first, first + 1e-3 * normal(g, shape[0], 1, *shape[2:])], 1)


_BLOCK = (1, 1, 4, 4)
_REGRESSION = checked(
    ops.block_regression,
    _regressed,
    ordinary("one block", _BLOCK, block=4),
    ordinary("a square", _BLOCK, block=4, squares=1),
    ordinary("blocks of 3, a large ridge", (1, 2, 4, 3), block=3, ridge=0.1, squares=2),
    ordinary("one row", (1, 1, 1, 6), count=1, block=4, offset=(3, 2)),
    stiff("features that differ by a thousandth", _BLOCK, smooth=_IMAGE, features=_nearly, block=4),
    stiff("millimetres", _BLOCK, smooth=_IMAGE, features=between(5e3, 6e3), count=3, squares=3, block=4),
    # Finite differences are too inaccurate for dependent features, and for features with a large mean.
    extreme("a flat wall", (1, 1, 4, 5), normal, _IMAGE, features=_dependent, squares=1, block=4),
    extreme("positions of 1e6", _BLOCK, normal, _IMAGE, features=between(1e6, 1e6 + 1), squares=2, block=4),
    extreme("more features than pixels", (1, 1, 2, 2), normal, _IMAGE, count=5, squares=2, block=4),
    # No squares: a feature that is nearly all in one pixel is proportional to its square.
    *(extreme(f"features {name}", features=draw, block=3, offset=(1, 2)) for name, draw in IMAGES.items()),
    settings=({"block": 3, "offset": (1, 2), "squares": 1},),
    fireflies=stiff("fireflies", _BLOCK, radiance, _IMAGE, block=4),
    smooth=_IMAGE,
    images=_IMAGE,
)

OPS = (
    checked(ops.downsample, _image, images=_IMAGE),
    checked(ops.upsample, _halved, images=_IMAGE),
    _FUSION,
    _demodulation(ops.demodulate),
    _demodulation(ops.remodulate),
    _SPLAT,
    _SLICE,
    _FIREFLIES,
    _ATROUS,
    checked(ops.luminance_moments, _light, image=uniform, least_dtype=torch.float32),
    _VARIANCE,
    _REGRESSION,
)
