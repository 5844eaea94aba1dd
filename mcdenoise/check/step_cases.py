"""The table of fused steps with their test cases, like :mod:`mcdenoise.check.cases` for the public ops.

Their formulas in float64 are in ``tests/oracles/steps.py``.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Generator, Tensor

from mcdenoise.check import _temporal
from mcdenoise.check.case import Case, Draw, Inputs, Op, between, normal, uniform
from mcdenoise.ops._steps import history, network

# Batch, height and width.
Size = tuple[int, int, int]
# An argument of a step, for images of a size.
Argument = Callable[[Size, Generator], Any]
SIZES: dict[str, Size] = {"5x7": (1, 5, 7), "batch of 2": (2, 3, 4), "one row": (1, 1, 6), "one pixel": (1, 1, 1)}


def _images(
    channels: int, draw: Draw = between(0.1, 3.0), change: Callable[[Tensor], object] | None = None
) -> Argument:
    def drawn(size: Size, g: Generator) -> Tensor:
        images = draw(g, size[0], channels, *size[1:])
        if change is not None:
            change(images)
        return images

    return drawn


def _step(
    function: Callable[..., Any], arguments: dict[str, Argument], smooth: str, extra: tuple[Case, ...] = (), **more: Any
) -> Op:
    """A step with a case of each size; between accumulation and convolutions frames are in float32 at least."""
    cases = (
        Case(name, "ordinary", partial(_drawn, arguments, size), tuple(smooth.split())) for name, size in SIZES.items()
    )
    return Op(function, (*cases, *extra), half_precision=False, **more)


def _drawn(arguments: dict[str, Argument], size: Size, g: Generator) -> Inputs:
    return {name: draw(size, g) for name, draw in arguments.items()}


def _factor(size: Size, g: Generator) -> Tensor:
    return uniform(g, size[0], 1, 1, 1, low=0.5, high=2.0)


def _coarse(size: Size, g: Generator) -> Tensor:
    return normal(g, size[0], 3, (size[1] + 1) // 2, (size[2] + 1) // 2)


def _far_corner(depth: Tensor) -> None:
    depth[..., 0, -1] = torch.inf


def _firefly(color: Tensor) -> None:
    color[..., 0, 0] = 400


def _bright_corner(root: Tensor) -> None:
    root[..., : root.shape[-2] // 2 + 1, : root.shape[-1] // 2 + 1] = 6


_BUFFERS: dict[str, Argument] = {
    "image": _images(3),
    "albedo": _images(3, uniform),
    "normal": _images(3, normal),
    "depth": _images(1, between(1.0, 20.0), _far_corner),
    "current": _images(3),
    "length": _images(1, between(1.1, 4.0)),
    "exposure": _factor,
    "scale": lambda size, g: [_factor(size, g), _factor(size, g)],
}
_FUSION: dict[str, Argument] = {
    "fine": _images(3),
    "coarse": _coarse,
    "weight": lambda size, g: 0.3 * normal(g, 1, 6, 3, 3),
    "bias": lambda size, g: normal(g, 1),
}
_PARTS = tuple(_FUSION)
_HISTORY: dict[str, Argument] = {
    "entering": _images(3),
    "previous": _images(3),
    "previous_length": _images(1, between(1.0, 6.0)),
    # Stay away from whole pixels, where the derivative jumps.
    "motion": _images(2, between(0.1, 0.4)),
}

STEPS: tuple[Op, ...] = (
    _step(network.buffers_input, _BUFFERS, "image albedo normal current length exposure scale"),
    # Its weights have no batch axis.
    _step(
        network.gated_fusion,
        _FUSION,
        "fine coarse weight bias",
        (Case("logarithms", "ordinary", partial(_drawn, _FUSION, (1, 3, 5)), _PARTS, {"logarithms": True}),),
        batched=False,
    ),
    _step(
        history.incoming,
        {"color": _images(3, change=_firefly), "albedo": _images(3, between(0.1, 0.9))},
        "",
        least_dtype=torch.float32,
    ),
    _step(history.lights, {"root": _images(1, change=_bright_corner)}, ""),
    _step(history.blend, _HISTORY, "entering previous motion", rounds=_temporal.motion_rounds),
)
