"""Verification of the derivatives of every operator, or of a user's own function, by difference quotients."""

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

# A fixed seed makes failures reproducible; any upstream gradient has to work.
SEED = 0


@dataclass(frozen=True)
class GradcheckResult:
    """Result of checking one case of one operator.

    Args:
        op: name of the operator.
        case: name of the case.
        inputs: the arguments whose first and second derivatives were checked.
        passed: whether all of them agree.
        seconds: run time of the check.
        message: first line of the error; empty if there is none.
    """

    op: str
    case: str
    inputs: tuple[str, ...]
    passed: bool
    seconds: float
    message: str


def gradcheck(function: Callable[..., Any], *inputs: Tensor, order: int = 2) -> list[GradcheckResult]:
    """Compare the derivatives of a user's own function with difference quotients, in float64, number by number.

    ``mcdenoise gradcheck path/to/file.py:function`` does the same.

    Args:
        function: function of floating-point tensors, which returns one or several tensors.
        inputs: small tensors of any floating-point dtype; if some require gradients, only their derivatives are
            checked. Without them, the function's example inputs are used, see :mod:`mcdenoise.check.own`.
        order: 1 for first derivatives, 2 for second ones too.

    Returns:
        One result for each case.

    Raises:
        InputError: the function is not of this kind, or there are no inputs on which it runs.

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
        names: operators to check, or own functions, ``path/to/file.py:function`` or ``package.module:function``;
            ``None`` means all operators.

    Returns:
        One result for each case of each op that has a differentiable input.

    Raises:
        InputError: an operator or function does not exist, or there are no inputs on which it runs.
    """
    return [check_case(op, case) for op, case in select(names)]


def select(names: Sequence[str] | None = None) -> list[tuple[Op, Case]]:
    """The cases of :func:`check`, each with its operator; raises the same ``InputError``."""
    ops = OPS + STEPS if names is None else find_ops(names, OPS + STEPS)
    return [(op, case) for op in ops for case in op.cases if case.differentiable]


def check_case(op: Op, case: Case, order: int = 2) -> GradcheckResult:
    """Run :func:`check` for one case; with ``order`` 1, only for first derivatives."""
    start = time.perf_counter()
    try:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(SEED)
            message = _mismatch(op, case, order)
    except Exception as error:  # any exception is reported for its operator; the others continue
        message = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
    seconds = time.perf_counter() - start
    return GradcheckResult(op.name, case.name, case.differentiable, not message, seconds, message)


def _mismatch(op: Op, case: Case, order: int) -> str:
    """Describe the first mismatch. torch's own check runs only for own functions and each operator's smallest case."""
    function, arguments = _of_differentiable(op, case)
    batched = op.batched and all(len(tensor) for tensor in arguments)
    if batched:
        # The large batch of copies might select a fast backend, which would not verify the reference.
        with use("torch"):
            message = first_mismatch(function, arguments)
            if order > 1 and not message:
                message = second_mismatch(function, arguments)
        if message:
            return message
    # torch's check calls the operator for every number, and also tests undefined and non-deterministic gradients.
    if not batched or case is _smallest(op):
        torch.autograd.gradcheck(function, arguments, fast_mode=False)
        if order > 1:
            torch.autograd.gradgradcheck(function, arguments, fast_mode=False)
    return ""


def _smallest(op: Op) -> Case:
    """Among the cases with the most differentiable arguments, the one with the fewest (but some) numbers."""

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
    """The operator as a function of its differentiable tensors only, for one or several batches, and those tensors."""
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
    # A constant infinity (the motion of a point behind the camera) has no difference quotient. After it is masked, it
    # must not leave NaN in the gradients of other inputs.
    return torch.where(torch.isfinite(result), result, 0)
