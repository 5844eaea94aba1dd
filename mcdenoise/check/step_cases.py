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
from mcdenoise.check.case import Case, Draw, Inputs, Op, between
from mcdenoise.ops._steps import history

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


def _step(function: Callable[..., Any], arguments: dict[str, Argument], smooth: str, **more: Any) -> Op:
    """A step with a case of each size; between accumulation and convolutions frames are in float32 at least."""
    cases = tuple(
        Case(name, "ordinary", partial(_drawn, arguments, size), tuple(smooth.split())) for name, size in SIZES.items()
    )
    return Op(function, cases, half_precision=False, **more)


def _drawn(arguments: dict[str, Argument], size: Size, g: Generator) -> Inputs:
    return {name: draw(size, g) for name, draw in arguments.items()}


def _firefly(color: Tensor) -> None:
    color[..., 0, 0] = 400


def _bright_corner(root: Tensor) -> None:
    root[..., : root.shape[-2] // 2 + 1, : root.shape[-1] // 2 + 1] = 6


_HISTORY: dict[str, Argument] = {
    "entering": _images(3),
    "previous": _images(3),
    "previous_length": _images(1, between(1.0, 6.0)),
    # Stay away from whole pixels, where the derivative jumps.
    "motion": _images(2, between(0.1, 0.4)),
}

STEPS: tuple[Op, ...] = (
    _step(
        history.incoming,
        {"color": _images(3, change=_firefly), "albedo": _images(3, between(0.1, 0.9))},
        "",
        least_dtype=torch.float32,
    ),
    _step(history.lights, {"root": _images(1, change=_bright_corner)}, ""),
    _step(history.blend, _HISTORY, "entering previous motion", rounds=_temporal.motion_rounds),
)
