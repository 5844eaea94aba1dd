"""The description of an operator and its test cases; the table of all operators is :mod:`mcdenoise.check.cases`."""

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
    """A test case: one set of inputs of an operator.

    Args:
        name: what is special about the case; unique for its operator.
        kind: ``"ordinary"``, ``"stiff"`` (results change fast with the inputs) or ``"extreme"`` (valid, at a limit).
        tensors: draws the tensor arguments by name, in float64.
        differentiable: the tensor arguments that have a derivative in this case.
        settings: the other arguments, which the Module twin stores.
    """

    name: str
    kind: Kind
    tensors: Callable[[Generator], Inputs]
    differentiable: tuple[str, ...]
    settings: dict[str, Any] = field(default_factory=dict)

    def inputs(self, dtype: torch.dtype = torch.float64, seed: int = 0) -> Inputs:
        """The tensor arguments in any dtype; the same seed gives the same numbers.

        Finite values stay finite: values beyond the dtype's range become its largest number, as in a saved image.
        """
        largest = torch.finfo(dtype).max

        def convert(tensor: Tensor) -> Tensor:
            return torch.where(tensor.isfinite(), tensor.clamp(-largest, largest), tensor).to(dtype)

        return map_tensors(convert, self.tensors(torch.Generator().manual_seed(seed)))


@dataclass(frozen=True)
class Rounding:
    """The effect of rounding inside an operator, in units of the dtype's epsilon.

    Every operator is assumed to be backward stable: its result is exact for inputs that are perturbed by a few
    roundings. If it computes with larger intermediate values than its inputs, their magnitude is stated here.

    Args:
        arguments: for some arguments, the magnitude of the intermediate values; for others it is their own.
        result: magnitude of values that are rounded in addition to the result.
        gradients: for some arguments, the magnitude of the terms whose difference is their gradient, for upstream
            gradients of one. Those of a quotient, ``n' / s - n s' / s^2``, are much larger than the gradient if they
            cancel.
    """

    arguments: Inputs = field(default_factory=dict)
    result: float = 0.0
    gradients: Inputs = field(default_factory=dict)


def _no_more(inputs: Inputs, settings: dict[str, Any]) -> Rounding:
    return Rounding()


@dataclass(frozen=True)
class Op:
    """An operator and its known properties.

    Args:
        function: the public function.
        reference: its equation in float64; see :mod:`mcdenoise.check.reference`.
        cases: at least four test cases, including ordinary ones.
        module: the Module twin, if there is one.
        least_dtype: results have at least this precision; otherwise they have the dtype of the inputs.
        images: the image arguments with a common unit: the first result scales with them, and is constant if they are
            and the weights sum to one.
        weights: whether, for given settings, the result is non-negative weights that sum to one over the channels.
        rounding: returns :class:`Rounding` for inputs and settings.
        half: whether the operator makes promises for inputs in half precision.
        batched: whether all its tensors begin with the batch axis, and it processes the images of a batch
            independently, so that many inputs can be tried at once.
        own: whether it is a user's own function, see :mod:`mcdenoise.check.own`. Its only reference is the function
            itself in float64, so its derivatives are verified wherever it is checked; it may process the images of a
            batch together; and half precision is rounded between its steps.
    """

    function: Callable[..., Any]
    reference: Callable[..., Any]
    cases: tuple[Case, ...]
    module: type[nn.Module] | None = None
    least_dtype: torch.dtype | None = None
    images: tuple[str, ...] = ()
    weights: Callable[[dict[str, Any]], bool] = lambda settings: False
    rounding: Callable[[Inputs, dict[str, Any]], Rounding] = _no_more
    half: bool = True
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
    """Radiance over six decades like that of 1-spp renderings: mostly dark, fireflies up to 1e4."""
    return 10 ** uniform(g, *shape, low=-2, high=4)
