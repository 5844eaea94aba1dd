"""The fast forms of per-pixel kernel convolution and of its transpose as torch operators."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from mcdenoise.ops._fast._filter import derivatives, filtered
from mcdenoise.ops._fast._operator import custom_op
from mcdenoise.ops._fast._plain import plain_gradients
from mcdenoise.ops.kernel_conv import kernel_conv_torch, kernel_splat_torch

_ARGUMENTS = "Tensor image, Tensor kernel, str border"


@custom_op("mcdenoise::kernel_conv", device_types="cpu", schema=f"({_ARGUMENTS}) -> Tensor")
def kernel_conv(image: Tensor, kernel: Tensor, border: Any) -> Tensor:
    """See :func:`mcdenoise.ops.kernel_conv`."""
    return filtered(image, kernel, (), (), None, False, border)


@custom_op("mcdenoise::kernel_splat", device_types="cpu", schema=f"({_ARGUMENTS}) -> Tensor")
def kernel_splat(image: Tensor, kernel: Tensor, border: Any) -> Tensor:
    """See :func:`mcdenoise.ops.kernel_splat`: what a convolution's derivative spreads over its image."""
    return derivatives(image, image, kernel, (), (), None, False, border)[0]


# Both are bilinear maps of one trilinear form, <y, kernel_conv(x, k)> = <kernel_splat(y, k), x>, and its derivative in
# the kernel is the same whichever of the two images is called the gradient.
@custom_op(
    "mcdenoise::kernel_conv_backward",
    device_types="cpu",
    schema=f"(Tensor gradient, {_ARGUMENTS}) -> (Tensor, Tensor)",
)
def _backward(gradient: Tensor, image: Tensor, kernel: Tensor, border: Any) -> tuple[Tensor, Tensor]:
    of_image, of_kernel, *_ = derivatives(gradient, image, kernel, (), (), None, False, border)
    return of_image, of_kernel


@kernel_conv.register_fake
@kernel_splat.register_fake
def _(image: Tensor, kernel: Tensor, border: str) -> Tensor:
    return image.new_empty(image.shape)


@_backward.register_fake
def _(gradient: Tensor, image: Tensor, kernel: Tensor, border: str) -> tuple[Tensor, Tensor]:
    return image.new_empty(image.shape), torch.empty_like(kernel)


def _setup_context(ctx: Any, inputs: Any, output: Tensor) -> None:
    image, kernel, ctx.border = inputs
    ctx.save_for_backward(image, kernel)


def _gradients_on_record(ctx: Any, plain: Callable[..., Tensor], gradient: Tensor) -> tuple[Tensor | None, ...]:
    of_image, of_kernel = plain_gradients(
        lambda image, kernel: plain(image, kernel, ctx.border), ctx.saved_tensors, ctx.needs_input_grad[:2], gradient
    )
    return of_image, of_kernel, None


def _conv_gradients(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    if torch.is_grad_enabled():
        return _gradients_on_record(ctx, kernel_conv_torch, gradient)
    return *_backward(gradient, *ctx.saved_tensors, ctx.border), None


def _splat_gradients(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    if torch.is_grad_enabled():
        return _gradients_on_record(ctx, kernel_splat_torch, gradient)
    image, kernel = ctx.saved_tensors
    of_image = kernel_conv(gradient, kernel, ctx.border) if ctx.needs_input_grad[0] else None
    of_kernel = _backward(image, gradient, kernel, ctx.border)[1] if ctx.needs_input_grad[1] else None
    return of_image, of_kernel, None


kernel_conv.register_autograd(_conv_gradients, setup_context=_setup_context)
kernel_splat.register_autograd(_splat_gradients, setup_context=_setup_context)
