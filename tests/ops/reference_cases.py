"""Cases for the fast backends of the filters, and results and derivatives beside those of the reference."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from mcdenoise.check.cases import OPS, Case, Inputs, Op, map_tensors
from mcdenoise.ops import use
from mcdenoise.ops._backend import Backend

FAST = [op for op in OPS if op.name in ("kernel_conv", "kernel_splat", "cross_bilateral_filter")]
# The tolerance is relative to the largest number in the case. Half precision is rounded once, after a sum in float32;
# a derivative in float32 is a sum over up to 49 taps of products of sums.
TOLERANCE = {
    torch.float64: 1e-13,
    torch.float32: 32 * torch.finfo(torch.float32).eps,
    torch.bfloat16: torch.finfo(torch.bfloat16).eps,
    torch.float16: torch.finfo(torch.float16).eps,
}


def by(backend: Backend, function: Callable[..., Any]) -> Callable[..., Any]:
    """The function in one backend."""

    def run(*arguments: Any, **settings: Any) -> Any:
        with use(backend):
            return function(*arguments, **settings)

    return run


def leaves_of(inputs: Inputs, case: Case) -> list[Tensor]:
    leaves: list[Tensor] = []
    map_tensors(
        lambda tensor: leaves.append(tensor.requires_grad_()) or tensor,
        {name: inputs[name] for name in case.differentiable},
    )
    return leaves


def outcomes(op: Op, case: Case, inputs: Inputs, backend: str) -> list[Tensor]:
    """The results and, times a random upstream gradient, each derivative of the first."""
    leaves = leaves_of(inputs, case)
    results = by(backend, op.function)(**inputs, **case.settings)
    result, *others = (results,) if isinstance(results, Tensor) else results
    upstream = torch.randn(result.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return [result.detach(), *others, *torch.autograd.grad(result, leaves, upstream.to(result.dtype))]


def assert_same(actual: list[Tensor], exact: list[Tensor], tolerance: float) -> None:
    largest = max(1.0, *(tensor.abs().max().item() for tensor in exact))
    for a, e in zip(actual, exact, strict=True):
        assert a.shape == e.shape
        assert (a.double() - e).abs().max().item() <= tolerance * largest


def drawn(batch: int, channels: int, height: int, width: int, kernel_size: int, op: Op, **settings: Any) -> Case:
    def tensors(g: torch.Generator) -> Inputs:
        def draw(count: int) -> Tensor:
            return torch.rand(batch, count, height, width, generator=g, dtype=torch.float64)

        inputs: Inputs = {"image": draw(channels), "kernel": draw(kernel_size**2) + 0.1}
        if op.name == "cross_bilateral_filter":
            inputs |= {"guides": [draw(3), draw(1)], "falloffs": [draw(1), 3 * draw(1)], "distance_falloff": draw(1)}
        return inputs

    names = ("image", "kernel", "guides", "falloffs", "distance_falloff")
    return Case("drawn", "ordinary", tensors, names if op.name == "cross_bilateral_filter" else names[:2], settings)


def channels_last(tensor: Tensor) -> Tensor:
    return tensor.contiguous(memory_format=torch.channels_last)


def slice_of_pixels(tensor: Tensor) -> Tensor:
    """Channels-last with other channels beside its own, as a network's prediction holds its logits."""
    return channels_last(torch.cat([torch.full_like(tensor, torch.nan), tensor], 1))[:, tensor.shape[1] :]


def every_other_column(tensor: Tensor) -> Tensor:
    return torch.stack([tensor, torch.full_like(tensor, torch.nan)], -1).flatten(-2)[..., ::2]


def transposed(tensor: Tensor) -> Tensor:
    return tensor.transpose(-1, -2).contiguous().transpose(-1, -2)
