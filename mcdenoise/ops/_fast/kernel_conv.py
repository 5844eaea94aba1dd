"""The fast forms of per-pixel kernel convolution and of its transpose as torch operators."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from mcdenoise.ops._fast._filter import filter_of
from mcdenoise.ops._fast._operator import custom_op
from mcdenoise.ops._fast._plain import plain_gradients
from mcdenoise.ops.kernel_conv import kernel_conv_torch, kernel_splat_torch

_ARGUMENTS = "Tensor image, Tensor kernel, str border, str backend"


@custom_op("mcdenoise::kernel_conv", schema=f"({_ARGUMENTS}) -> Tensor")
def kernel_conv(image: Tensor, kernel: Tensor, border: str, backend: str) -> Tensor:
    """See :func:`mcdenoise.ops.kernel_conv`."""
    result: Tensor = filter_of(backend).filtered(image, kernel, (), (), None, False, border)
    return result


@custom_op("mcdenoise::kernel_splat", schema=f"({_ARGUMENTS}) -> Tensor")
def kernel_splat(image: Tensor, kernel: Tensor, border: str, backend: str) -> Tensor:
    """See :func:`mcdenoise.ops.kernel_splat`."""
    result: Tensor = filter_of(backend).splatted(image, kernel, border)
    return result


# Both are bilinear maps of one trilinear form, <y, kernel_conv(x, k)> = <kernel_splat(y, k), x>, and its derivative in
# the kernel is the same whichever of the two images is called the gradient.
@custom_op(
    "mcdenoise::kernel_conv_backward",
    schema=f"(Tensor gradient, {_ARGUMENTS}) -> (Tensor, Tensor)",
)
def _backward(gradient: Tensor, image: Tensor, kernel: Tensor, border: str, backend: str) -> tuple[Tensor, Tensor]:
    of_image, of_kernel, *_ = filter_of(backend).derivatives(gradient, image, kernel, (), (), None, False, border)
    return of_image, of_kernel


@kernel_conv.register_fake
@kernel_splat.register_fake
def _(image: Tensor, kernel: Tensor, border: str, backend: str) -> Tensor:
    return image.new_empty(image.shape)


@_backward.register_fake
def _(gradient: Tensor, image: Tensor, kernel: Tensor, border: str, backend: str) -> tuple[Tensor, Tensor]:
    return image.new_empty(image.shape), torch.empty_like(kernel)


def _setup_context(ctx: Any, inputs: Any, output: Tensor) -> None:
    image, kernel, ctx.border, ctx.backend = inputs
    ctx.save_for_backward(image, kernel)


def _gradients_on_record(ctx: Any, plain: Callable[..., Tensor], gradient: Tensor) -> tuple[Tensor | None, ...]:
    of_image, of_kernel = plain_gradients(
        lambda image, kernel: plain(image, kernel, ctx.border), ctx.saved_tensors, ctx.needs_input_grad[:2], gradient
    )
    return of_image, of_kernel, None, None


def _conv_gradients(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    if torch.is_grad_enabled():
        return _gradients_on_record(ctx, kernel_conv_torch, gradient)
    return *_backward(gradient, *ctx.saved_tensors, ctx.border, ctx.backend), None, None


def _splat_gradients(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    if torch.is_grad_enabled():
        return _gradients_on_record(ctx, kernel_splat_torch, gradient)
    image, kernel = ctx.saved_tensors
    of_image = kernel_conv(gradient, kernel, ctx.border, ctx.backend) if ctx.needs_input_grad[0] else None
    of_kernel = _backward(image, gradient, kernel, ctx.border, ctx.backend)[1] if ctx.needs_input_grad[1] else None
    return of_image, of_kernel, None, None


kernel_conv.register_autograd(_conv_gradients, setup_context=_setup_context)
kernel_splat.register_autograd(_splat_gradients, setup_context=_setup_context)
