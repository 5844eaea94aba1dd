"""The table of fused steps with their test cases, like :mod:`mcdenoise.check.cases` for the public ops.

Their formulas in float64 are in ``tests/oracles/steps.py``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Generator, Tensor

from mcdenoise.check import _temporal
from mcdenoise.check.case import Case, Inputs, Op, normal, uniform
from mcdenoise.ops._steps import history, network

Size = tuple[int, int, int]
SIZES: tuple[tuple[str, Size], ...] = (
    ("5x7", (1, 5, 7)),
    ("batch of 2", (2, 3, 4)),
    ("one row", (1, 1, 6)),
    ("one pixel", (1, 1, 1)),
)


def _cases(
    tensors: Callable[[Size, Generator], Inputs], differentiable: tuple[str, ...], /, **settings: Any
) -> tuple[Case, ...]:
    return tuple(Case(name, "ordinary", partial(tensors, size), differentiable, dict(settings)) for name, size in SIZES)


def _positive(size: Size, g: Generator, channels: int = 3) -> Tensor:
    return uniform(g, size[0], channels, *size[1:], low=0.1, high=3.0)


def _factor(size: Size, g: Generator) -> Tensor:
    return uniform(g, size[0], 1, 1, 1, low=0.5, high=2.0)


def _depth(size: Size, g: Generator) -> Tensor:
    depth = uniform(g, size[0], 1, *size[1:], low=1.0, high=20.0)
    depth[..., 0, -1] = torch.inf
    return depth


def _buffers(size: Size, g: Generator) -> Inputs:
    depth = _depth(size, g)
    return {
        "albedo": uniform(g, size[0], 3, *size[1:]),
        "normal": normal(g, size[0], 3, *size[1:]),
        "depth": depth,
        "current": _positive(size, g),
        "length": 1 + _positive(size, g, 1),
        "exposure": _factor(size, g),
        "scale": [_factor(size, g), _factor(size, g)],
    }


def _buffers_input(size: Size, g: Generator) -> Inputs:
    return {"image": _positive(size, g), **_buffers(size, g)}


def _half(size: Size) -> Size:
    return size[0], (size[1] + 1) // 2, (size[2] + 1) // 2


def _fusion(size: Size, g: Generator) -> Inputs:
    return {
        "fine": _positive(size, g),
        "coarse": normal(g, size[0], 3, *_half(size)[1:]),
        "weight": 0.3 * normal(g, 1, 6, 3, 3),
        "bias": normal(g, 1),
    }


def _entering(size: Size, g: Generator) -> Inputs:
    color = _positive(size, g)
    color[..., 0, 0] = 400
    return {"color": color, "albedo": uniform(g, size[0], 3, *size[1:], low=0.1, high=0.9)}


def _root(size: Size, g: Generator) -> Inputs:
    root = _positive(size, g, 1)
    root[..., : size[1] // 2 + 1, : size[2] // 2 + 1] = 6
    return {"root": root}


def _history(channels: tuple[int, int], size: Size, g: Generator) -> Inputs:
    entering, previous = _positive((size[0], *size[1:]), g, channels[0]), _positive(size, g, channels[1])
    return {
        "entering": entering,
        "previous": previous,
        "previous_length": uniform(g, size[0], 1, *size[1:], low=1.0, high=6.0),
        # Stay away from whole pixels, where the derivative jumps.
        "motion": uniform(g, size[0], 2, *size[1:], low=0.1, high=0.4),
    }


_BUFFERS = ("albedo", "normal", "current", "length", "exposure", "scale")

# Between accumulation and a network's convolutions frames are in float32, so steps need not support half precision.
STEPS: tuple[Op, ...] = tuple(
    replace(step, half_precision=False)
    for step in (
        Op(network.buffers_input, _cases(_buffers_input, ("image", *_BUFFERS))),
        # Its weights have no batch axis.
        Op(
            network.gated_fusion,
            (
                *_cases(_fusion, ("fine", "coarse", "weight", "bias")),
                Case(
                    "logarithms",
                    "ordinary",
                    partial(_fusion, (1, 3, 5)),
                    ("fine", "coarse", "weight", "bias"),
                    {"logarithms": True},
                ),
            ),
            batched=False,
        ),
        Op(history.incoming, _cases(_entering, ()), least_dtype=torch.float32),
        Op(history.lights, _cases(_root, ())),
        Op(
            history.blend,
            _cases(partial(_history, (3, 3)), ("entering", "previous", "motion")),
            rounds=_temporal.motion_rounds,
        ),
    )
)
