"""An op that runs on one case, in one dtype, on one backend."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass

import torch
from torch import Tensor

from mcdenoise.check.case import Case, Inputs, Op, as_tuple, map_tensors, tensors_in
from mcdenoise.check.stability._check import Check, bounded
from mcdenoise.ops import Surface, use
from mcdenoise.ops._backend import Backend
from mcdenoise.ops._op import backends_of
from mcdenoise.ops._window import accumulator_dtype

Function = Callable[[Sequence[Tensor]], list[Tensor]]


@dataclass(frozen=True)
class Trial:
    """An op, a case, a dtype and a backend, with the inputs."""

    op: Op
    case: Case
    dtype: torch.dtype
    backend: Backend | None
    inputs: Inputs

    @property
    def leaves(self) -> list[Tensor]:
        """The tensors that are rounded; surfaces are not, because they are only compared."""
        return tensors_in(self.numbers)

    @property
    def inner(self) -> torch.dtype:
        """The dtype in which the op computes."""
        return self.dtype if self.op.own else accumulator_dtype(self.dtype)

    @property
    def must_be_finite(self) -> bool:
        """Whether float64 must be finite: a user's function has no other reference, and NaN would excuse any result."""
        return self.op.own and all(bool(leaf.isfinite().all()) for leaf in self.leaves)

    @property
    def numbers(self) -> Inputs:
        """The arguments that are rounded."""
        return {name: value for name, value in self.inputs.items() if not isinstance(value, Surface)}

    def found(
        self, what: str, error: float = 0.0, allowed: float = 0.0, condition: float = 0.0, message: str = ""
    ) -> Check:
        """A check of the trial, see :func:`bounded`."""
        about = self.op.name, self.case.name, self.dtype
        return bounded(*about, what, error, allowed, condition, message, self.backend or "")

    def run(self, leaves: Sequence[Tensor]) -> list[Tensor]:
        """Run the op with other tensors in place of :attr:`leaves`, possibly with several copies of the batch."""
        remaining = iter(leaves)
        given = map_tensors(lambda _: next(remaining), self.numbers)
        surfaces = {name: value for name, value in self.inputs.items() if name not in given}
        copies = leaves[0].shape[0] // max(self.leaves[0].shape[0], 1) if surfaces else 1
        repeated = map_tensors(lambda tensor: tensor.to(leaves[0].dtype).repeat(copies, 1, 1, 1), surfaces)
        # In float64 the op always runs on the first backend, the reference.
        backend = self.backend if leaves[0].dtype == self.dtype else backends(self.op)[0]
        with use(backend) if backend else nullcontext():
            results = self.op.function(**given, **repeated, **self.case.settings)
        return list(as_tuple(results))

    def gradients(self, leaves: Sequence[Tensor]) -> list[Tensor]:
        """Gradients of the results; the last of ``leaves`` are the upstream gradients, the others the tensors."""
        own = [leaf.detach().requires_grad_() for leaf in leaves[: len(self.leaves)]]
        with torch.enable_grad():
            results = self.run(own)
            pairs = [(r, v) for r, v in zip(results, leaves[len(own) :], strict=True) if r.requires_grad]
            if not pairs:
                return [torch.zeros_like(leaf) for leaf in own]
            gradients = torch.autograd.grad(
                [result for result, _ in pairs], own, [v.to(result.dtype) for result, v in pairs], allow_unused=True
            )
        return [torch.zeros_like(x) if g is None else g for x, g in zip(own, gradients, strict=True)]


def backends(op: Op) -> tuple[Backend | None, ...]:
    """The backends of an op; ``(None,)`` if it has only one."""
    found = backends_of(op.function)
    return found if len(found) > 1 else (None,)
