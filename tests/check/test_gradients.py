from typing import Any

import torch
from torch import Tensor

from mcdenoise.check.case import uniform
from mcdenoise.check.cases import OPS, STEPS, Case, Op
from mcdenoise.check.gradients import check_case, select


class _Forgetful(torch.autograd.Function):
    """A correct function whose gradient has no derivative in the image."""

    @staticmethod
    def forward(ctx: Any, image: Tensor) -> Tensor:
        ctx.save_for_backward(image)
        return image * image

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (image,) = ctx.saved_tensors
        return 2 * image.detach() * gradient


class _Leaking(torch.autograd.Function):
    """A function that is correct for one image, but mixes the gradients of several images."""

    @staticmethod
    def forward(ctx: object, image: Tensor) -> Tensor:
        return 2 * image

    @staticmethod
    def backward(ctx: object, gradient: Tensor) -> Tensor:
        return gradient + gradient.mean(0, keepdim=True)


def result_of(function: object, order: int = 2, images: int = 1) -> tuple[bool, str]:
    case = Case("pixels", "ordinary", lambda g: {"image": uniform(g, images, 1, 2, 3)}, ("image",))
    result = check_case(Op(function, (case,)), case, order)  # type: ignore[arg-type]
    return result.passed, result.message


def test_a_wrong_second_derivative_fails() -> None:
    assert result_of(_Forgetful.apply, order=1) == (True, "")
    passed, message = result_of(_Forgetful.apply)
    assert not passed
    assert "second derivatives: Jacobian mismatch" in message


def test_a_derivative_that_leaks_to_another_image_fails() -> None:
    image = torch.rand(1, 1, 2, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(_Leaking.apply, image)
    passed, message = result_of(_Leaking.apply, order=1, images=2)
    assert not passed
    assert "Jacobian mismatch for output 0 with respect to input 0: element 0 of the output in element 0" in message


def test_an_op_that_raises_fails_with_its_message() -> None:
    def broken(image: Tensor) -> Tensor:
        raise RuntimeError("\nit broke")

    assert result_of(broken) == (False, "it broke")


def test_every_op_has_a_case_to_check() -> None:
    assert {op.name for op, _ in select()} == {op.name for op in OPS + STEPS if op.cases[0].differentiable}
