"""What a case of an op is, and what the table of ops says of each; the table itself is :mod:`mcdenoise.check.cases`."""

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
        name: what is special about it; unique within its op.
        kind: ``"ordinary"``, ``"stiff"`` (results change fast with the inputs) or ``"extreme"`` (valid, but at the end
            of what is).
        tensors: draws the tensor arguments by name, in float64.
        differentiable: the arguments among them that have a derivative here.
        settings: the other arguments, those that the Module twin stores.
    """

    name: str
    kind: Kind
    tensors: Callable[[Generator], Inputs]
    differentiable: tuple[str, ...]
    settings: dict[str, Any] = field(default_factory=dict)

    def inputs(self, dtype: torch.dtype = torch.float64, seed: int = 0) -> Inputs:
        """The tensor arguments: the same numbers for the same seed, in any dtype.

        What is finite stays so: beyond the dtype's range it is its largest number, as in an image that was saved.
        """
        largest = torch.finfo(dtype).max

        def convert(tensor: Tensor) -> Tensor:
            return torch.where(tensor.isfinite(), tensor.clamp(-largest, largest), tensor).to(dtype)

        return map_tensors(convert, self.tensors(torch.Generator().manual_seed(seed)))


@dataclass(frozen=True)
class Rounding:
    """What the roundings inside of an op amount to, in units of the dtype's epsilon.

    Every op is taken to be backward stable: its result is the exact one of inputs that are off by few roundings. Where
    an op computes with larger numbers on the way than its inputs are, this says with how large ones.

    Args:
        arguments: for some arguments, the magnitude whose rounding they must absorb; for the others it is their own.
        result: magnitude that is rounded beside the result itself.
        gradients: for some arguments, the magnitude of the terms whose difference is their gradient, for upstream
            gradients of one. A quotient's, ``n' / s - n s' / s^2``, are much larger than it is where they cancel.
    """

    arguments: Inputs = field(default_factory=dict)
    result: float = 0.0
    gradients: Inputs = field(default_factory=dict)


def _no_more(inputs: Inputs, settings: dict[str, Any]) -> Rounding:
    return Rounding()


@dataclass(frozen=True)
class Op:
    """An op and what is known about it.

    Args:
        function: the public function.
        reference: the same as its equation, in float64; see :mod:`mcdenoise.check.reference`.
        cases: at least four, among them ordinary ones.
        module: the Module twin, if there is one.
        least_dtype: results are at least as precise as this; other results have the dtype of the inputs.
        images: the arguments that are images of one unit: the first result scales with them, and is constant where
            they are and the weights sum to one.
        weights: whether, with these settings, the result is non-negative weights that sum to one over the channels.
        rounding: see :class:`Rounding`; of inputs and settings.
        half: whether it promises anything of inputs in half precision.
        batched: whether all its tensors have the batch first, and it treats the images of a batch alike and alone, so
            that many inputs can be tried at once.
        own: whether it is somebody's own function, see :mod:`mcdenoise.check.own`. Its only equation is itself in
            float64, so that its derivatives are proven wherever it is checked; it may treat the images of a batch
            together; and half precision is rounded between its steps.
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
    """``inputs`` with ``function`` applied to each tensor in them."""

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
    """Over six decades, as 1-spp renderings are: mostly dark, fireflies up to 1e4."""
    return 10 ** uniform(g, *shape, low=-2, high=4)
