"""Regimes of inputs, by which every op is tried: ordinary sizes, fireflies, and the ends of what an image may hold.

An op has a builder, ``build(g, size, image, **given)``, which draws its arguments for an image of that size from the
generator ``g``; ``image`` draws what is radiance. :func:`checked` gives the op all regimes, and rows of its own, in
which other arguments are special.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from typing import Any

from torch import Generator, Tensor

from mcdenoise.check.case import Case, Draw, Inputs, Kind, Op, alternating, constant, dim, normal, radiance, uniform

Size = tuple[int, int, int, int]
Builder = Callable[..., Inputs]
_SETTING = inspect.Parameter.KEYWORD_ONLY

# Tiny, because errors are bounded by perturbing one element at a time, and odd, because errors at borders show there.
ORDINARY: dict[str, Size] = {
    "RGB, 3x5": (1, 3, 3, 5),
    "batch of 2": (2, 1, 2, 3),
    "one row, 5 channels": (1, 5, 1, 5),
    "one pixel": (1, 3, 1, 1),
}
# Of ops whose many taps make a derivative expensive.
SMALL: dict[str, Size] = {
    "2x3": (1, 1, 2, 3),
    "batch of 2": (2, 1, 1, 2),
    "one row, RGB": (1, 3, 1, 4),
    "one pixel": (1, 2, 1, 1),
}


def _forty_decades(g: Generator, *shape: int) -> Tensor:
    return 10 ** uniform(g, *shape, low=-30, high=10)


# Black, a denormal number, far below and far above the range of half precision, its end; neighbours that differ by all
# that float32 holds, and neighbours that cancel.
IMAGES: dict[str, Draw] = {
    **{f"constant {value:g}": constant(value) for value in (0.0, 1e-40, 1e-30, 65504.0, 1e30)},
    "six decades": radiance,
    "forty decades": _forty_decades,
    "alternating signs": alternating(6e4),
}
# Sizes that are difficult for borders, windows and strides.
SIZES: dict[str, Size] = {
    "one pixel": (1, 1, 1, 1),
    "one row of 9": (1, 3, 1, 9),
    "one column of 9": (1, 3, 9, 1),
    "64 channels": (1, 64, 2, 3),
    "no image": (0, 3, 2, 4),
}


@dataclass(frozen=True)
class Row:
    """A regime, or one that only one op has.

    Args:
        name: of the case.
        kind: of the case.
        size: of the image.
        image: draws radiance.
        smooth: the arguments in which finite differences are meaningful: all by default, and none at an extreme.
        given: arguments of the builder, and settings of the op.
    """

    name: str
    kind: Kind
    size: Size
    image: Draw
    smooth: tuple[str, ...] | None
    given: Mapping[str, Any]


def _rows(kind: Kind, size: Size, image: Draw, smooth: tuple[str, ...] | None) -> Callable[..., Row]:
    def row(
        name: str, size: Size = size, /, image: Draw = image, smooth: tuple[str, ...] | None = smooth, **given: Any
    ) -> Row:
        return Row(name, kind, size, image, smooth, given)

    return row


# A row whose derivatives are checked; one in which results change fast with the inputs; and one at the limits of valid
# input, of which the step of finite differences, 1e-6, is too large or too small.
ordinary = _rows("ordinary", (1, 1, 2, 3), normal, None)
stiff = _rows("stiff", (1, 1, 2, 3), normal, None)
extreme = _rows("extreme", (1, 3, 2, 4), radiance, ())

FIREFLIES = stiff("fireflies", (1, 3, 2, 3), dim)


def checked(
    function: Callable[..., Any],
    build: Builder,
    *rows: Row,
    settings: Sequence[Mapping[str, Any]] = ({},),
    sizes: Mapping[str, Size] = ORDINARY,
    image: Draw = normal,
    limits: Mapping[str, Draw] = IMAGES,
    fireflies: Row | None = FIREFLIES,
    smooth: tuple[str, ...] | None = None,
    **properties: Any,
) -> Op:
    """An op with its cases: all regimes, in turn with some settings, and rows of its own.

    Args:
        function: the op.
        build: its builder.
        rows: regimes that no other op has.
        settings: of the op, and arguments of the builder; ordinary and extreme regimes take them in turn.
        sizes: of the ordinary regimes.
        image: of the ordinary regimes.
        limits: images of the extreme regimes; there are none for an op without one.
        fireflies: the regime of fireflies.
        smooth: of the ordinary regimes.
        properties: the others of the :class:`Op`.
    """
    usual = [
        Row(_named(name, given), "ordinary", size, image, smooth, given)
        for (name, size), given, _ in zip(
            cycle(sizes.items()), cycle(settings), range(max(len(sizes), len(settings))), strict=False
        )
    ]
    tried = [(name, (1, 3, 2, 4), draw) for name, draw in limits.items()]
    tried += [(f"{name}, six decades", size, radiance) for name, size in SIZES.items() if limits]
    extremes = [
        Row(_named(name, given), "extreme", size, draw, (), given)
        for (name, size, draw), given in zip(tried, cycle(settings), strict=False)
    ]
    bright = [] if fireflies is None else [fireflies]
    return Op(function, tuple(_case(function, build, row) for row in (*usual, *bright, *rows, *extremes)), **properties)


def _named(name: str, given: Mapping[str, Any]) -> str:
    parts = (f"{key} {value}" for key, value in given.items() if not callable(value))
    return ", ".join([name, *parts])


def _case(function: Callable[..., Any], build: Builder, row: Row) -> Case:
    parameters = inspect.signature(function).parameters
    takes = inspect.signature(build).parameters
    settings = {
        key: value for key, value in row.given.items() if key in parameters and parameters[key].kind == _SETTING
    }
    if "size" in parameters:
        settings["size"] = row.size[2:]
    knobs = {key: value for key, value in row.given.items() if key in takes}
    if unknown := row.given.keys() - settings.keys() - knobs.keys():
        raise TypeError(f"{function.__name__}, {row.name}: neither the op nor its builder takes {sorted(unknown)}")
    draw = partial(build, size=row.size, image=row.image, **knobs)
    return Case(row.name, row.kind, draw, row.smooth, settings)
