"""Types of the table of ops in :mod:`mcdenoise.check.cases`: an op and its test cases."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Generator, Tensor, nn

from mcdenoise.ops.temporal import Surface

Kind = Literal["ordinary", "stiff", "extreme"]
Value = Tensor | list[Tensor] | Surface | None
Inputs = dict[str, Value]


@dataclass(frozen=True)
class Case:
    """One set of inputs of an op.

    Args:
        name: describes the inputs; unique within the op.
        kind: ``"ordinary"``, ``"stiff"`` (results change fast with the inputs) or ``"extreme"`` (at the limits of valid
            input).
        tensors: draws the tensor arguments by name, in float64.
        differentiable: the tensor arguments in which the op is differentiable at these inputs.
        settings: the other arguments, which the Module twin stores.
    """

    name: str
    kind: Kind
    tensors: Callable[[Generator], Inputs]
    differentiable: tuple[str, ...]
    settings: dict[str, Any] = field(default_factory=dict)

    def inputs(self, dtype: torch.dtype = torch.float64, seed: int = 0) -> Inputs:
        """The tensor arguments: the same numbers for the same seed, in any dtype.

        Finite values are clamped to the range of the dtype, as in a saved image.
        """
        largest = torch.finfo(dtype).max

        def convert(tensor: Tensor) -> Tensor:
            return torch.where(tensor.isfinite(), tensor.clamp(-largest, largest), tensor).to(dtype)

        return map_tensors(convert, self.tensors(torch.Generator().manual_seed(seed)))


@dataclass(frozen=True)
class Rounding:
    """Magnitudes of intermediate values that an op rounds, for error bounds.

    Every op is assumed to be backward stable: its result is the exact result of inputs that differ by a few rounding
    errors. For ops whose intermediate values are larger than their inputs, this gives the magnitudes to use instead.

    Args:
        arguments: for some arguments, the magnitude whose rounding error counts as an error of the argument; by default
            the magnitude of the argument itself.
        result: a magnitude that is rounded in addition to the result.
        gradients: for some arguments, the magnitude of terms that cancel in their gradient, for upstream gradients of
            1. For example, the terms of the derivative of a quotient, ``n' / s - n s' / s^2``, may be much larger than
            their difference.
    """

    arguments: Inputs = field(default_factory=dict)
    result: float = 0.0
    gradients: Inputs = field(default_factory=dict)


def _no_more(inputs: Inputs, settings: dict[str, Any]) -> Rounding:
    return Rounding()


@dataclass(frozen=True)
class Op:
    """An op with its test cases and properties.

    Args:
        function: the public function.
        reference: its equation as loops in float64; see :mod:`mcdenoise.check.reference`.
        cases: at least four cases, including ordinary ones.
        module: the Module twin, if there is one.
        least_dtype: minimum precision of the results; by default they have the dtype of the inputs.
        images: the arguments that are images in the same unit: the first result scales with them, and is constant if
            they are constant and the weights sum to one.
        weights: whether, with these settings, the results are non-negative weights that sum to one over the channels.
        rounding: returns the :class:`Rounding` for inputs and settings.
        half_precision: whether the op supports inputs in half precision.
        batched: whether the first axis of all tensors is the batch, and the op treats its images identically and
            independently, so that many inputs can be checked at once.
        own: whether it is a user's function, see :mod:`mcdenoise.check.own`. Its reference is itself in float64, whose
            derivatives are therefore checked first; it may combine the images of a batch; and in half precision its
            intermediate values are rounded.
    """

    function: Callable[..., Any]
    reference: Callable[..., Any]
    cases: tuple[Case, ...]
    module: type[nn.Module] | None = None
    least_dtype: torch.dtype | None = None
    images: tuple[str, ...] = ()
    weights: Callable[[dict[str, Any]], bool] = lambda settings: False
    rounding: Callable[[Inputs, dict[str, Any]], Rounding] = _no_more
    half_precision: bool = True
    batched: bool = True
    own: bool = False

    @property
    def name(self) -> str:
        """The function's name."""
        return self.function.__name__


def map_tensors(function: Callable[[Tensor], Tensor], inputs: Inputs) -> Inputs:
    """Apply ``function`` to each tensor in ``inputs``."""

    def apply(value: Value) -> Value:
        if isinstance(value, Surface):
            return Surface(*(None if part is None else function(part) for part in value))
        if isinstance(value, list):
            return [function(part) for part in value]
        return None if value is None else function(value)

    return {name: apply(value) for name, value in inputs.items()}


def uniform(g: Generator, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
    """Uniformly distributed numbers in ``[low, high)``, float64."""
    return low + (high - low) * torch.rand(*shape, generator=g, dtype=torch.float64)


def normal(g: Generator, *shape: int) -> Tensor:
    """Normally distributed numbers of variance one, float64."""
    return torch.randn(*shape, generator=g, dtype=torch.float64)


def radiance(g: Generator, *shape: int) -> Tensor:
    """Radiance over six decades, as in renderings of one sample per pixel: mostly dark, with fireflies up to 1e4."""
    return 10 ** uniform(g, *shape, low=-2, high=4)
