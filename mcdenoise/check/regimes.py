"""The table of regimes: in each of them every op is tried, with arguments drawn as its row of the table of ops says.

Regimes are sizes, fireflies, and the ends of what an image and each other argument may hold. :func:`checked` joins an
op, its arguments and all regimes, and adds rows that only this op has, in which its settings are special.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import cycle, islice
from types import MappingProxyType
from typing import Any

from torch import Generator, Tensor

from mcdenoise.check.case import (
    Case,
    Draw,
    Inputs,
    Kind,
    Op,
    alternating,
    constant,
    dim,
    normal,
    powers,
    radiance,
)

Size = tuple[int, int, int, int]
WIDE: Size = (1, 3, 2, 4)
# Makes a case of an op and its arguments.
Row = Callable[..., Case]
# Changes drawn arguments that depend on others, and on the settings.
Relation = Callable[[dict[str, Any], Mapping[str, Any]], None]
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
# Black, a denormal number, far below and far above the range of half precision, its end; neighbours that differ by all
# that float32 holds, and neighbours that cancel.
IMAGES: dict[str, Draw] = {
    **{f"constant {value:g}": constant(value) for value in (0.0, 1e-40, 1e-30, 65504.0, 1e30)},
    "six decades": radiance,
    "forty decades": powers(-30, 10),
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
class Argument:
    """How an argument of an op is drawn.

    Args:
        draw: its numbers; by default those of an image, which the regime draws.
        channels: their number, by default that of the image; several numbers make a list of tensors.
        limits: draws of what it may hold at most, each of which is an extreme regime.
        axes: those after the channels, for the size of the image and the settings of the op.
        scales: whether the first result of the op scales with it, and with all others that do.
    """

    draw: Draw | None = None
    channels: int | tuple[int, ...] | None = None
    limits: Mapping[str, Draw] = field(default_factory=dict)
    axes: Callable[[Size, Mapping[str, Any]], tuple[int, ...]] = lambda size, settings: size[2:]
    scales: bool = False

    def drawn(self, g: Generator, size: Size, image: Draw, settings: Mapping[str, Any]) -> Tensor | list[Tensor]:
        """Its numbers for an image of that size, of which ``image`` draws the radiance."""
        draw, axes = self.draw or image, self.axes(size, settings)
        if isinstance(self.channels, tuple):
            return [draw(g, size[0], count, *axes) for count in self.channels]
        return draw(g, size[0], size[1] if self.channels is None else self.channels, *axes)

    def but(self, given: Any) -> Argument:
        """With another draw, another number of channels, or a list of both."""
        parts = given if isinstance(given, list) else [given]
        return replace(self, **{"draw" if callable(each) else "channels": each for each in parts})


IMAGE = Argument(scales=True)


def half(size: Size, settings: Mapping[str, Any]) -> tuple[int, ...]:
    """Half of the height and of the width."""
    return (size[2] + 1) // 2, (size[3] + 1) // 2


# An image of half the size.
HALF = replace(IMAGE, axes=half)


def _rows(kind: Kind, size: Size, image: Draw, smooth: tuple[str, ...] | None) -> Callable[..., Row]:
    def row(
        name: str,
        size: Size = size,
        /,
        image: Draw = image,
        smooth: tuple[str, ...] | None = smooth,
        only: str | None = None,
        change: Callable[[dict[str, Any]], object] | None = None,
        **given: Any,
    ) -> Row:
        """A regime that only one op has.

        Args:
            name: of the case.
            size: of the image.
            image: draws radiance.
            smooth: the arguments in which finite differences are meaningful: all by default, and none at an extreme.
            only: names of the arguments that the op gets, by default all.
            change: changes the arguments that were drawn.
            given: settings of the op, and for other arguments a draw, a number of channels, or a list of both.
        """

        def case(function: Callable[..., Any], arguments: Mapping[str, Argument], relate: Relation) -> Case:
            parameters = inspect.signature(function).parameters
            settings = {key: given[key] for key in given if key in parameters and parameters[key].kind == _SETTING}
            if "size" in parameters:
                settings["size"] = size[2:]
            if unknown := given.keys() - settings.keys() - arguments.keys():
                raise TypeError(f"{function.__name__}, {name}: it has no argument {sorted(unknown)}")
            drawn = {key: each.but(given[key]) if key in given else each for key, each in arguments.items()}

            def draw(g: Generator) -> Inputs:
                inputs: Inputs = {key: each.drawn(g, size, image, settings) for key, each in drawn.items()}
                relate(inputs, settings)
                if change is not None:
                    change(inputs)
                return {key: inputs[key] for key in (inputs if only is None else only.split())}

            return Case(name, kind, draw, smooth, settings)

        return case

    return row


# A row whose derivatives are checked; one in which results change fast with the inputs; and one at the limits of valid
# input, of which the step of finite differences, 1e-6, is too large or too small.
ordinary = _rows("ordinary", (1, 1, 2, 3), normal, None)
stiff = _rows("stiff", (1, 1, 2, 3), normal, None)
extreme = _rows("extreme", WIDE, radiance, ())

FIREFLIES = stiff("fireflies", (1, 3, 2, 3), dim)


def checked(
    function: Callable[..., Any],
    arguments: Mapping[str, Argument],
    *rows: Row,
    settings: Mapping[str, Sequence[Any]] = MappingProxyType({}),
    sizes: Mapping[str, Size] = ORDINARY,
    image: Draw = normal,
    limits: Mapping[str, Draw] = IMAGES,
    fireflies: Row | None = FIREFLIES,
    smooth: tuple[str, ...] | None = None,
    relate: Relation = lambda inputs, settings: None,
    **properties: Any,
) -> Op:
    """An op with its cases: all regimes, in turn with some settings, and rows of its own.

    Args:
        function: the op.
        arguments: its tensors, and others that only ``relate`` needs.
        rows: regimes that no other op has.
        settings: of what rows may be given some values each, which ordinary and extreme regimes take in turn.
        sizes: of the ordinary regimes.
        image: of the ordinary regimes.
        limits: images of the extreme regimes; there are none for an op without one.
        fireflies: the regime of fireflies.
        smooth: of the ordinary regimes.
        relate: changes drawn arguments that depend on others.
        properties: the others of the :class:`Op`.
    """

    def turn(number: int) -> dict[str, Any]:
        return {key: values[number % len(values)] for key, values in settings.items()}

    usual = islice(cycle(sizes.items()), max(len(each) for each in (sizes, *settings.values())))
    found = [ordinary(_named(name, turn(i)), size, image, smooth, **turn(i)) for i, (name, size) in enumerate(usual)]
    found += rows if fireflies is None else (fireflies, *rows)
    ends: list[tuple[str, Size, Draw, dict[str, Any]]] = [(name, WIDE, draw, {}) for name, draw in limits.items()]
    ends += [(f"{name}, six decades", size, radiance, {}) for name, size in SIZES.items() if limits]
    for key, argument in arguments.items():
        # All arguments are there at the limit of one.
        ends += [(f"{key} {name}", WIDE, radiance, {key: draw, "only": None}) for name, draw in argument.limits.items()]
    for i, (name, size, draw, end) in enumerate(ends):
        found.append(extreme(_named(name, turn(i)), size, draw, **{**turn(i), **end}))
    cases = tuple(row(function, arguments, relate) for row in found)
    images = tuple(name for name, argument in arguments.items() if argument.scales)
    return Op(function, cases, images=images, **properties)


def _named(name: str, given: Mapping[str, Any]) -> str:
    parts = (f"{key} {value}" for key, value in given.items() if isinstance(value, int | float | str) and key != "only")
    return ", ".join([name, *parts])
