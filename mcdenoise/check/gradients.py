"""Checks of the derivatives of every op, or of a function of your own, against finite differences."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any, TypeAlias

import torch
from torch import Tensor
from torch.autograd.gradcheck import GradcheckError

from mcdenoise.check.case import as_tuple, tensors_in
from mcdenoise.check.cases import Case, Inputs, Op, map_tensors
from mcdenoise.check.own import find_ops, op_of
from mcdenoise.errors import first_line
from mcdenoise.ops import use

Function: TypeAlias = Callable[..., tuple[Tensor, ...]]

# Makes failures reproducible; the checks must pass for any upstream gradient.
SEED = 0
# Those of torch's check.
_STEP, _ABSOLUTE, _RELATIVE = 1e-6, 1e-5, 1e-3


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


def select(names: Sequence[str] | None = None) -> list[tuple[Op, Case]]:
    """The cases that have a differentiable input, each with its op.

    Args:
        names: ops to check, or functions of your own, ``path/to/file.py:function`` or ``package.module:function``;
            ``None`` means all ops.

    Raises:
        InputError: there is no such op or function, or the function runs on none of its example inputs.
    """
    return [(op, case) for op in find_ops(names) for case in op.cases if case.differentiable]


def check_case(op: Op, case: Case, order: int = 2) -> GradcheckResult:
    """Compare first and second derivatives with finite differences, in float64; with ``order`` 1 only first ones."""
    start = time.perf_counter()
    try:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(SEED)
            message = _mismatch(op, case, order)
    except Exception as error:  # an op may raise any exception; it is reported, and the other cases continue
        message = first_line(error)
    seconds = time.perf_counter() - start
    return GradcheckResult(op.name, case.name, case.differentiable, not message, seconds, message)


def _mismatch(op: Op, case: Case, order: int) -> str:
    """The first mismatch, or an empty string; other errors that torch's own check finds are raised."""
    function, arguments = _of_differentiable(op, case)
    # Random combinations of all elements show a wrong one, in a hundredth of the time; a user asks for each element.
    fast = not op.own and all(len(tensor) for tensor in arguments)
    try:
        # Without this, a fast backend might be chosen for a large image, and the reference would not be checked.
        with nullcontext() if op.own else use("torch"):
            torch.autograd.gradcheck(function, arguments, fast_mode=fast)
            if order > 1:
                torch.autograd.gradgradcheck(function, arguments, fast_mode=fast)
    except GradcheckError:
        # The first line of torch's message does not say where the Jacobians differ.
        message = _located(function, arguments, order)
        if not message:
            raise
        return message
    return ""


def _located(function: Function, arguments: Sequence[Tensor], order: int) -> str:
    """The first element whose first or second derivative differs from its difference quotient; empty if none does."""
    inputs, outputs = ([tensor.numel() for tensor in each] for each in (arguments, function(*arguments)))
    point = torch.cat([argument.detach().flatten() for argument in arguments])
    upstream = 2 * torch.rand(sum(outputs), dtype=point.dtype) - 1

    def flat(numbers: Tensor) -> Tensor:
        parts = zip(numbers.split(inputs), arguments, strict=True)
        return torch.cat([each.flatten() for each in function(*(part.view_as(whole) for part, whole in parts))])

    def slopes(numbers: Tensor) -> Tensor:
        numbers = numbers if numbers.requires_grad else numbers.detach().requires_grad_()
        with torch.enable_grad():
            return torch.autograd.grad((flat(numbers) * upstream).sum(), numbers, create_graph=True)[0]

    for sizes, each, what in ((outputs, flat, ""), (inputs, slopes, "second derivatives: "))[:order]:
        derivatives = torch.autograd.functional.jacobian(each, point)
        steps = _STEP * torch.eye(len(point), dtype=point.dtype)
        pairs = [(each(point + step), each(point - step)) for step in steps]
        differences = torch.stack([(up - down).detach() / (2 * _STEP) for up, down in pairs], 1)
        beyond = ~torch.isclose(derivatives, differences, rtol=_RELATIVE, atol=_ABSOLUTE)
        if beyond.any():
            row, column = beyond.nonzero()[0].tolist()
            (output, element), (argument, number) = _place(row, sizes), _place(column, inputs)
            return (
                f"{what}Jacobian mismatch for output {output} with respect to input {argument}: element {element} of "
                f"the output in element {number} of the input has the difference quotient "
                f"{differences[row, column]:.6g} and the derivative {derivatives[row, column]:.6g}"
            )
    return ""


def _place(index: int, sizes: Sequence[int]) -> tuple[int, int]:
    """Which of several tensors has a number that is counted through all of them, and where."""
    part = 0
    while index >= sizes[part]:
        index, part = index - sizes[part], part + 1
    return part, index


def _of_differentiable(op: Op, case: Case) -> tuple[Function, tuple[Tensor, ...]]:
    """The op as a function of its differentiable tensors only, and these tensors."""
    fixed = case.inputs()
    chosen: Inputs = {name: fixed[name] for name in case.differentiable}

    def function(*tensors: Tensor) -> tuple[Tensor, ...]:
        remaining = iter(tensors)
        given = map_tensors(lambda _: next(remaining), chosen)
        return tuple(map(_finite, as_tuple(op.function(**(fixed | given), **case.settings))))

    return function, tuple(tensor.requires_grad_() for tensor in tensors_in(chosen))


def _finite(result: Tensor) -> Tensor:
    # A constant infinity (the motion of a point behind the camera) has no finite difference. It is replaced here, but
    # must not cause NaN in other gradients.
    return torch.where(torch.isfinite(result), result, 0)
