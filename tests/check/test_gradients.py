from __future__ import annotations

import torch
from torch import Tensor

from mcdenoise.check.case import uniform
from mcdenoise.check.cases import OPS, Case, Op
from mcdenoise.check.gradients import check_case, select
from mcdenoise.check.step_cases import STEPS


class _Wrong(torch.autograd.Function):
    @staticmethod
    def forward(ctx: object, image: Tensor) -> Tensor:
        return image * image

    @staticmethod
    def backward(ctx: object, gradient: Tensor) -> Tensor:
        return gradient


def result_of(function: object) -> tuple[bool, str]:
    case = Case("pixels", "ordinary", lambda g: {"image": uniform(g, 1, 1, 2, 2)}, ("image",))
    op = Op(function, function, (case,))  # type: ignore[arg-type]
    result = check_case(op, case)
    return result.passed, result.message


def test_a_right_derivative_passes() -> None:
    def square(image: Tensor) -> Tensor:
        return image * image

    assert result_of(square) == (True, "")


def test_a_wrong_derivative_fails() -> None:
    def square(image: Tensor) -> Tensor:
        return _Wrong.apply(image)

    passed, message = result_of(square)
    assert not passed
    assert "Jacobian mismatch" in message


def test_an_op_that_raises_fails_with_its_words() -> None:
    def broken(image: Tensor) -> Tensor:
        raise RuntimeError("\nit broke")

    assert result_of(broken) == (False, "it broke")


def test_every_op_has_a_case_to_check() -> None:
    assert {op.name for op, _ in select()} == {op.name for op in OPS + STEPS if op.cases[0].differentiable}
