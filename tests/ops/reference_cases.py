"""The ops with a fast backend, inputs for them, and layouts of these in memory."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from mcdenoise.check.case import as_tuple
from mcdenoise.check.cases import OPS, Case, Inputs, Op
from mcdenoise.ops import use
from mcdenoise.ops._backend import Backend
from mcdenoise.ops._op import backends_of

# The tolerance is relative to the largest number in the case. Half precision is rounded once, after a sum in float32.
TOLERANCE = {
    torch.float64: 1e-12,
    torch.float32: 32 * torch.finfo(torch.float32).eps,
    torch.bfloat16: torch.finfo(torch.bfloat16).eps,
    torch.float16: torch.finfo(torch.float16).eps,
}
FAST = [op for op in OPS if "numba" in backends_of(op.function)]


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def by(backend: Backend, function: Callable[..., Any]) -> Callable[..., Any]:
    def run(*arguments: Any, **settings: Any) -> Any:
        with use(backend):
            return function(*arguments, **settings)

    return run


def outcomes(op: Op, case: Case, inputs: Inputs, backend: Backend) -> list[Tensor]:
    return list(as_tuple(by(backend, op.function)(**inputs, **case.settings)))


def assert_same(actual: Sequence[Tensor], exact: Sequence[Tensor], tolerance: float) -> None:
    for a, e in zip(actual, exact, strict=True):
        assert a.shape == e.shape
        known = e.isfinite()
        assert torch.equal(a.isfinite(), known)
        largest = e[known].abs().max().item() if known.any() else 0.0
        assert torch.all((a[known].double() - e[known]).abs() <= tolerance * max(1.0, largest))


def channels_last(tensor: Tensor) -> Tensor:
    return tensor.movedim(1, -1).contiguous().movedim(-1, 1)


def slice_of_pixels(tensor: Tensor) -> Tensor:
    """Channels-last with other channels beside its own, as a network's prediction holds its logits."""
    return channels_last(torch.cat([torch.full_like(tensor, torch.nan), tensor], 1))[:, tensor.shape[1] :]


def every_other_column(tensor: Tensor) -> Tensor:
    return torch.stack([tensor, torch.full_like(tensor, torch.nan)], -1).flatten(-2)[..., ::2]


def transposed(tensor: Tensor) -> Tensor:
    return tensor.transpose(-1, -2).contiguous().transpose(-1, -2)


LAYOUTS = (channels_last, slice_of_pixels, every_other_column, transposed)
