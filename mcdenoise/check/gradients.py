"""Prove the derivatives of every op, or of a function of one's own, against difference quotients."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from mcdenoise.check._jacobian import first_mismatch, second_mismatch
from mcdenoise.check.cases import OPS, Case, Inputs, Op, map_tensors
from mcdenoise.check.own import find_ops, op_of
from mcdenoise.check.step_cases import STEPS
from mcdenoise.ops import use

# Only to make a failure repeatable: any upstream gradient must do.
SEED = 0


@dataclass(frozen=True)
class GradcheckResult:
    """What became of one case of one op.

    Args:
        op: name of the op.
        case: name of the case.
        inputs: the arguments whose first and second derivatives were checked.
        passed: whether all of them agree.
        seconds: time it took.
        message: first line of what is wrong; empty if nothing is.
    """

    op: str
    case: str
    inputs: tuple[str, ...]
    passed: bool
    seconds: float
    message: str


def gradcheck(function: Callable[..., Any], *inputs: Tensor, order: int = 2) -> list[GradcheckResult]:
    """Compare the derivatives of a function of one's own with difference quotients, in float64 and number by number.

    ``mcdenoise gradcheck path/to/file.py:function`` does the same.

    Args:
        function: of floating-point tensors, which returns one or several.
        inputs: small tensors to try it on, of any floating-point dtype; those alone that require gradients are moved,
            if any does. Without them, its example inputs, see :mod:`mcdenoise.check.own`.
        order: 1 for first derivatives, 2 for second ones too.

    Returns:
        One result for each case.

    Raises:
        InputError: it is no such function, or there is nothing that it runs on.

    Example:
        >>> import torch
        >>> from mcdenoise.check import gradcheck
        >>> [result.passed for result in gradcheck(torch.sin, torch.rand(1, 3, 2, 2))]
        [True]
    """
    op = op_of(function, inputs)
    return [check_case(op, case, order) for case in op.cases if case.differentiable]


def check(names: Sequence[str] | None = None) -> list[GradcheckResult]:
    """Compare first and second derivatives with difference quotients, in float64 and number by number.

    Args:
        names: ops to check, or functions of one's own, ``path/to/file.py:function`` or ``package.module:function``;
            ``None`` means all ops.

    Returns:
        One result for each case of each op that has a differentiable input.

    Raises:
        InputError: there is no such op or function, or nothing that it runs on.
    """
    return [check_case(op, case) for op, case in select(names)]


def select(names: Sequence[str] | None = None) -> list[tuple[Op, Case]]:
    """The cases that :func:`check` goes through, each with its op; ``InputError`` as there."""
    ops = OPS + STEPS if names is None else find_ops(names, OPS + STEPS)
    return [(op, case) for op in ops for case in op.cases if case.differentiable]


def check_case(op: Op, case: Case, order: int = 2) -> GradcheckResult:
    """:func:`check` of one case; of ``order`` 1, of first derivatives alone."""
    start = time.perf_counter()
    try:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(SEED)
            message = _mismatch(op, case, order)
    except Exception as error:  # whatever an op raises belongs in the report of that op, and the others go on
        message = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
    seconds = time.perf_counter() - start
    return GradcheckResult(op.name, case.name, case.differentiable, not message, seconds, message)


def _mismatch(op: Op, case: Case, order: int) -> str:
    """What is wrong; torch's own check, of functions of one's own and of the smallest case of an op, raises it."""
    function, arguments = _of_differentiable(op, case)
    batched = op.batched and all(len(tensor) for tensor in arguments)
    if batched:
        # Of the many copies together a fast backend may be chosen, which would prove nothing of the plain one.
        with use("torch"):
            message = first_mismatch(function, arguments)
            if order > 1 and not message:
                message = second_mismatch(function, arguments)
        if message:
            return message
    # It calls the op for every number, and looks at more: gradients that are undefined, or not the same each time.
    if not batched or case is _smallest(op):
        torch.autograd.gradcheck(function, arguments, fast_mode=False)
        if order > 1:
            torch.autograd.gradgradcheck(function, arguments, fast_mode=False)
    return ""


def _smallest(op: Op) -> Case:
    """Of the cases with derivatives in the most arguments the one with the fewest numbers, but with some."""

    def size(case: Case) -> tuple[int, float]:
        numbers = 0

        def count(tensor: Tensor) -> Tensor:
            nonlocal numbers
            numbers += tensor.numel()
            return tensor

        map_tensors(count, case.inputs())
        return -len(case.differentiable), numbers or math.inf

    return min((case for case in op.cases if case.differentiable), key=size)


def _of_differentiable(op: Op, case: Case) -> tuple[Callable[..., tuple[Tensor, ...]], tuple[Tensor, ...]]:
    """The op as a function of its differentiable tensors alone, of one or several batches, and those tensors."""
    fixed = case.inputs()
    arguments: list[Tensor] = []

    def collect(tensor: Tensor) -> Tensor:
        arguments.append(tensor.requires_grad_())
        return tensor

    map_tensors(collect, {name: fixed[name] for name in case.differentiable})

    def function(*tensors: Tensor) -> tuple[Tensor, ...]:
        remaining, copies = iter(tensors), len(tensors[0]) // max(len(arguments[0]), 1) if tensors[0].ndim else 1
        given: Inputs = {name: fixed[name] for name in case.differentiable}
        others = {name: value for name, value in fixed.items() if name not in given}
        if copies > 1:
            others = map_tensors(lambda tensor: tensor.repeat(copies, *(1,) * (tensor.ndim - 1)), others)
        result = op.function(**others, **map_tensors(lambda _: next(remaining), given), **case.settings)
        return tuple(map(_finite, (result,) if isinstance(result, Tensor) else result))

    return function, tuple(arguments)


def _finite(result: Tensor) -> Tensor:
    # A constant infinity (the motion of a point behind the camera) has no difference quotient. Cut out, it still must
    # not leave a NaN in the gradient of anything else.
    return torch.where(torch.isfinite(result), result, 0)
