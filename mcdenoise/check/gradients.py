"""Checks of the derivatives of every op, or of a function of your own, against finite differences."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.gradcheck import GradcheckError

from mcdenoise.check._jacobian import first_mismatch, one_by_one, second_mismatch
from mcdenoise.check.cases import OPS, Case, Inputs, Op, map_tensors
from mcdenoise.check.own import find_ops, op_of
from mcdenoise.check.step_cases import STEPS
from mcdenoise.ops import use

# Makes failures reproducible; the checks must pass for any upstream gradient.
SEED = 0


@dataclass(frozen=True)
class GradcheckResult:
    """Result of the gradient check of one case of an op.

    Args:
        op: name of the op.
        case: name of the case.
        inputs: the arguments whose derivatives were checked.
        passed: whether all derivatives agree.
        seconds: run time of the check.
        message: the first mismatch, or the first line of another error's message; empty if the check passed.
    """

    op: str
    case: str
    inputs: tuple[str, ...]
    passed: bool
    seconds: float
    message: str


def gradcheck(function: Callable[..., Any], *inputs: Tensor, order: int = 2) -> list[GradcheckResult]:
    """Compare the derivatives of a function of your own with finite differences, in float64 and element by element.

    ``mcdenoise gradcheck path/to/file.py:function`` does the same.

    Args:
        function: takes floating-point tensors, and returns one or several.
        inputs: small example inputs of any floating-point dtype. If some of them require gradients, derivatives are
            checked in these only. By default the function's example inputs, see :mod:`mcdenoise.check.own`.
        order: 1 to check first derivatives, 2 to check second derivatives too.

    Returns:
        One result for each case.

    Raises:
        InputError: ``function`` is not such a function, or it runs on none of its example inputs.

    Example:
        >>> import torch
        >>> from mcdenoise.check import gradcheck
        >>> [result.passed for result in gradcheck(torch.sin, torch.rand(1, 3, 2, 2))]
        [True]
    """
    op = op_of(function, inputs)
    return [check_case(op, case, order) for case in op.cases if case.differentiable]


def check(names: Sequence[str] | None = None) -> list[GradcheckResult]:
    """Compare first and second derivatives with finite differences, in float64 and element by element.

    Args:
        names: ops to check, or functions of your own, ``path/to/file.py:function`` or ``package.module:function``;
            ``None`` means all ops.

    Returns:
        One result for each case that has a differentiable input.

    Raises:
        InputError: there is no such op or function, or the function runs on none of its example inputs.
    """
    return [check_case(op, case) for op, case in select(names)]


def select(names: Sequence[str] | None = None) -> list[tuple[Op, Case]]:
    """The cases that :func:`check` checks, each with its op; raises ``InputError`` like it."""
    ops = OPS + STEPS if names is None else find_ops(names, OPS + STEPS)
    return [(op, case) for op in ops for case in op.cases if case.differentiable]


def check_case(op: Op, case: Case, order: int = 2) -> GradcheckResult:
    """:func:`check` for one case; with ``order`` 1 only of first derivatives."""
    start = time.perf_counter()
    try:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(SEED)
            message = _mismatch(op, case, order)
    except Exception as error:  # an op may raise any exception; it is reported, and the other cases continue
        message = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
    seconds = time.perf_counter() - start
    return GradcheckResult(op.name, case.name, case.differentiable, not message, seconds, message)


def _mismatch(op: Op, case: Case, order: int) -> str:
    """The first mismatch, or an empty string; other errors that torch's own check finds are raised."""
    function, arguments = _of_differentiable(op, case)
    batched = op.batched and all(len(tensor) for tensor in arguments)
    if batched:
        # Without this, a fast backend might be chosen for a large batch, and the reference would not be checked.
        with use("torch"):
            message = first_mismatch(function, arguments)
            if order > 1 and not message:
                message = second_mismatch(function, arguments)
        if message:
            return message
    # torch's own check calls the op for every element, so it is used for users' functions and for the smallest case of
    # an op. It also finds undefined and non-deterministic gradients.
    if not batched or case is _smallest(op):
        try:
            torch.autograd.gradcheck(function, arguments, fast_mode=False)
            if order > 1:
                torch.autograd.gradgradcheck(function, arguments, fast_mode=False)
        except GradcheckError:
            # The first line of torch's message does not say where the Jacobians differ.
            single, copies = one_by_one(function), [each[None] for each in arguments]
            message = first_mismatch(single, copies) or (second_mismatch(single, copies) if order > 1 else "")
            if not message:
                raise
            return message
    return ""


def _smallest(op: Op) -> Case:
    """The smallest non-empty case among those with derivatives in the largest number of arguments."""

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
    """The op as a function of its differentiable tensors only, for one or several batches, and these tensors."""
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
    # A constant infinity (the motion of a point behind the camera) has no finite difference. It is replaced here, but
    # must not cause NaN in other gradients.
    return torch.where(torch.isfinite(result), result, 0)
