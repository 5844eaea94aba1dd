"""Overview of all operators in ``mcdenoise.ops``, with measured errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from mcdenoise.check.cases import OPS, Case, Op

DTYPES = (torch.float32, torch.bfloat16, torch.float16)


@dataclass(frozen=True)
class OpOverview:
    """One row of the overview.

    Args:
        name: name of the operator.
        summary: first line of its docstring.
        differentiable: its differentiable arguments.
        cases: number of its test cases.
        errors: by dtype (``"float32"``), the largest relative error over the ordinary cases; see
            :func:`relative_error`.
        module: name of the Module twin, if there is one.
    """

    name: str
    summary: str
    differentiable: tuple[str, ...]
    cases: int
    errors: dict[str, float]
    module: str | None


def overview() -> list[OpOverview]:
    """One entry per operator; its error against the equations in float64 is measured by this call."""
    return [
        OpOverview(
            name=op.name,
            summary=(op.function.__doc__ or "").strip().partition("\n")[0],
            differentiable=tuple(dict.fromkeys(name for case in op.cases for name in case.differentiable)),
            cases=len(op.cases),
            errors={
                str(dtype).removeprefix("torch."): max(
                    relative_error(op, case, dtype) for case in op.cases if case.kind == "ordinary"
                )
                for dtype in DTYPES
            },
            module=None if op.module is None else op.module.__name__,
        )
        for op in OPS
    ]


def relative_error(op: Op, case: Case, dtype: torch.dtype) -> float:
    """``max |out - reference| / max |reference|``, the maximum over the operator's results.

    Both get the same inputs, rounded to ``dtype``; the reference computes in float64. Where ``dtype`` cannot represent
    the reference, infinity is the right result; any other infinite or NaN result counts as an infinite error.
    """
    inputs = case.inputs(dtype)
    results = op.function(**inputs, **case.settings)
    references = op.reference(**inputs, **case.settings)
    return max(
        _relative_error(out, reference)
        for out, reference in zip(_as_sequence(results), _as_sequence(references), strict=True)
    )


def _as_sequence(results: Any) -> Sequence[Tensor]:
    return (results,) if isinstance(results, Tensor) else results


def _relative_error(out: Tensor, reference: Tensor) -> float:
    representable = torch.isfinite(reference.to(out.dtype))
    if not torch.equal(torch.isfinite(out), representable):
        return float("inf")
    if not out.numel():
        return 0.0
    difference = torch.where(representable, out.double() - reference, 0).abs().max().item()
    return difference / max(torch.where(representable, reference, 0).abs().max().item(), torch.finfo(out.dtype).tiny)
