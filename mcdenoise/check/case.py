"""Types of the table of ops in :mod:`mcdenoise.check.cases`: an op and its test cases, and draws of their numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, Literal

import torch
from torch import Generator, Tensor, nn
from torch.utils import _pytree as pytree

from mcdenoise import ops
from mcdenoise.ops import Surface

Kind = Literal["ordinary", "stiff", "extreme"]
Value = Tensor | list[Tensor] | Surface | None
Inputs = dict[str, Value]
# Takes a generator and a shape.
Draw = Callable[..., Tensor]
# In which ops are compared with themselves in float64.
DTYPES = (torch.float32, torch.bfloat16, torch.float16)


@dataclass(frozen=True)
class Case:
    """One set of inputs of an op.

    Args:
        name: describes the inputs; unique within the op.
        kind: ``"ordinary"``, ``"stiff"`` (results change fast with the inputs) or ``"extreme"`` (at the limits of valid
            input).
        tensors: draws the tensor arguments by name, in float64.
        smooth: the tensor arguments in which the op is differentiable at these inputs; by default all.
        settings: the other arguments, which the Module twin stores.
    """

    name: str
    kind: Kind
    tensors: Callable[[Generator], Inputs]
    smooth: tuple[str, ...] | None = None
    settings: dict[str, Any] = field(default_factory=dict)

    @cached_property
    def differentiable(self) -> tuple[str, ...]:
        """The names of :attr:`smooth`, or those of all tensors."""
        if self.smooth is not None:
            return self.smooth
        drawn = self.tensors(torch.Generator().manual_seed(0))
        return tuple(
            key for key, value in drawn.items() if isinstance(value, Tensor) or (value and type(value) is list)
        )

    def inputs(self, dtype: torch.dtype = torch.float64, seed: int = 0) -> Inputs:
        """The tensor arguments: the same numbers for the same seed, in any dtype.

        Finite values are clamped to the range of the dtype, as in a saved image.
        """
        largest = torch.finfo(dtype).max

        def convert(tensor: Tensor) -> Tensor:
            return torch.where(tensor.isfinite(), tensor.clamp(-largest, largest), tensor).to(dtype)

        return map_tensors(convert, self.tensors(torch.Generator().manual_seed(seed)))


@dataclass(frozen=True)
class Op:
    """An op with its test cases and properties.

    Args:
        function: the public function. In float64 it is the reference of all other dtypes and backends.
        cases: at least four cases, including ordinary ones.
        images: the arguments that are images in the same unit: the first result scales with them, and is constant if
            they are constant and the weights sum to one.
        weights: whether, with these settings, the results are non-negative weights that sum to one over the channels.
        rounds: magnitudes that the op rounds, of inputs and settings, for error bounds: for some arguments one whose
            rounding error counts as an error of the argument, by default that of the argument itself; and as
            ``"result"`` one that is rounded in addition to the result; and as ``"gradient of NAME"`` terms that cancel.
            Ops are assumed to be backward stable, so that only those whose intermediate values are larger than their
            inputs need it.
        finite: whether results are finite where all inputs are.
        half_precision: whether the op supports inputs in half precision.
        own: whether it is a user's function, see :mod:`mcdenoise.check.own`. Its derivatives in float64 are checked
            first; it may combine the images of a batch, while ops treat them identically and independently, so that
            many inputs can be checked at once; and in half precision its intermediate values are rounded.
    """

    function: Callable[..., Any]
    cases: tuple[Case, ...]
    images: tuple[str, ...] = ()
    weights: Callable[[dict[str, Any]], bool] = lambda settings: False
    rounds: Callable[[Any, dict[str, Any]], Mapping[str, Any]] = lambda inputs, settings: {}
    finite: bool = True
    half_precision: bool = True
    own: bool = False

    @property
    def name(self) -> str:
        """The function's name."""
        return self.function.__name__

    @property
    def module(self) -> type[nn.Module] | None:
        """The Module twin, if there is one."""
        found: type[nn.Module] | None = getattr(ops, self.name.title().replace("_", ""), None)
        return found


def map_tensors(function: Callable[[Tensor], Tensor], inputs: Inputs) -> Inputs:
    """Apply ``function`` to each tensor in ``inputs``."""
    mapped: Inputs = pytree.tree_map_only(Tensor, function, inputs)
    return mapped


def tensors_in(inputs: Inputs) -> list[Tensor]:
    """The tensors of a case's inputs, in order."""
    return [each for each in pytree.tree_leaves(inputs) if isinstance(each, Tensor)]


def as_tuple(results: Any) -> tuple[Tensor, ...]:
    """The results of an op, of which there may be one or several."""
    return (results,) if isinstance(results, Tensor) else tuple(results)


def uniform(g: Generator, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
    """Uniformly distributed numbers in ``[low, high)``, float64."""
    return low + (high - low) * torch.rand(*shape, generator=g, dtype=torch.float64)


def normal(g: Generator, *shape: int) -> Tensor:
    """Normally distributed numbers of variance one, float64."""
    return torch.randn(*shape, generator=g, dtype=torch.float64)


def constant(value: float) -> Draw:
    """The same number everywhere."""
    return lambda g, *shape: torch.full(shape, value, dtype=torch.float64)


def numbers(*values: float) -> dict[str, Draw]:
    """Constants, by what they are."""
    return {f"{value:g}": constant(value) for value in values}


def between(low: float, high: float) -> Draw:
    """Uniformly distributed numbers."""
    return partial(uniform, low=low, high=high)


def powers(low: float, high: float) -> Draw:
    """Numbers of all magnitudes from ten to the power of ``low`` to ten to the power of ``high``."""
    return lambda g, *shape: 10 ** uniform(g, *shape, low=low, high=high)


def some(value: float, draw: Draw = normal) -> Draw:
    """The same number in one channel of all pixels, or of one image in its first column."""

    def drawn(g: Generator, *shape: int) -> Tensor:
        values = draw(g, *shape)
        values[(slice(None), 2) if shape[1] > 3 else (..., 0)] = value
        return values

    return drawn


def times(factor: float, draw: Draw, offset: float = 0.0) -> Draw:
    """Numbers of another distribution, scaled, and moved."""
    return lambda g, *shape: offset + factor * draw(g, *shape)


def alternating(size: float) -> Draw:
    """A checkerboard of both signs, for which sums over neighbours cancel."""

    def draw(g: Generator, *shape: int) -> Tensor:
        signs = 1 - 2 * (torch.arange(shape[-2])[:, None] + torch.arange(shape[-1])) % 2
        return size * signs * (1 + 0.1 * uniform(g, *shape))

    return draw


def softmax(spread: float, total: float = 1.0) -> Draw:
    """Weights of that sum; the larger the spread, the closer to a single one."""
    return lambda g, *shape: total * torch.softmax(spread * normal(g, *shape), 1)


# Radiance over six decades, as in renderings of one sample per pixel: mostly dark, with fireflies up to 1e4; and up to
# 100, beside which finite differences are accurate.
radiance, dim = powers(-2, 4), powers(-4, 2)
