"""List of the operators in ``mcdenoise.ops``, with their errors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from mcdenoise.check.case import DTYPES, as_tuple, map_tensors
from mcdenoise.check.cases import OPS, Case, Op
from mcdenoise.ops import use


def overview() -> list[dict[str, Any]]:
    """Summarize every op; this measures its errors against float64.

    Returns:
        For each op its ``name``; ``summary``, the first line of its docstring; ``differentiable``, the arguments in
        which it is; ``cases``, their number; ``errors`` by dtype (``"float32"``), the maximum relative error over the
        ordinary cases, see :func:`relative_error`; and ``module``, the name of the Module twin, if there is one.
    """
    return [
        {
            "name": op.name,
            "summary": (op.function.__doc__ or "").strip().partition("\n")[0],
            "differentiable": list(dict.fromkeys(name for case in op.cases for name in case.differentiable)),
            "cases": len(op.cases),
            "errors": {
                str(dtype).removeprefix("torch."): max(
                    relative_error(op, case, dtype) for case in op.cases if case.kind == "ordinary"
                )
                for dtype in DTYPES
            },
            "module": None if op.module is None else op.module.__name__,
        }
        for op in OPS
    ]


def relative_error(op: Op, case: Case, dtype: torch.dtype, function: Callable[..., Any] | None = None) -> float:
    """``max |out - exact| / max |exact|``, the maximum over the op's results.

    Both get the same inputs, rounded to ``dtype``; the exact result is that of plain torch in float64. Where it exceeds
    the range of ``dtype``, the result must be infinite; any other infinite or NaN result is an infinite error.

    Args:
        op: an op of the table.
        case: one of its cases.
        dtype: dtype of the inputs.
        function: what to measure; by default the op itself.
    """
    inputs = case.inputs(dtype)
    results = as_tuple((function or op.function)(**inputs, **case.settings))
    with use("torch"):
        exact = as_tuple(op.function(**map_tensors(Tensor.double, inputs), **case.settings))
    return max(_relative_error(one, other) for one, other in zip(results, exact, strict=True))


def _relative_error(out: Tensor, exact: Tensor) -> float:
    representable = torch.isfinite(exact.to(out.dtype))
    if not torch.equal(torch.isfinite(out), representable):
        return float("inf")
    if not out.numel():
        return 0.0
    difference = torch.where(representable, out.double() - exact, 0).abs().max().item()
    return difference / max(torch.where(representable, exact, 0).abs().max().item(), torch.finfo(out.dtype).tiny)
