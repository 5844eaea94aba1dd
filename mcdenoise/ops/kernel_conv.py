"""Per-pixel kernel convolution (gather) and its transpose (splat)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from mcdenoise.ops._autograd import Function
from mcdenoise.ops._check import check_shapes
from mcdenoise.ops._module import module_of
from mcdenoise.ops._op import op
from mcdenoise.ops._window import (
    Border,
    accumulator_dtype,
    check_border,
    inside,
    kernel_size_of,
    offsets,
    pad,
    shifted,
    unpad,
)


def _check(image: Tensor, kernel: Tensor, *, border: str = "replicate") -> None:
    sizes = check_shapes(image=(image, "B C H W"), kernel=(kernel, "B T H W"))
    check_border(border)
    kernel_size_of(sizes["T"], "kernel")


@op("numba", check=_check, differentiable=True)
def kernel_conv(image: Tensor, kernel: Tensor, *, border: Border = "replicate") -> Tensor:
    """Filter an image with a kernel of its own at every pixel; all channels share the pixel's kernel.

    ``out[p] = sum_t kernel[t, p] * image[p + o_t]`` over the offsets ``o_t`` of the ``K x K`` window.

    Args:
        image: ``(B, C, H, W)``, any unit and range.
        kernel: ``(B, K*K, H, W)`` weights, odd ``K``, taps row by row from top left; used as they are.
        border: value of a tap outside the image: ``"replicate"`` the nearest edge pixel, ``"zeros"`` zero;
            ``"renormalize"`` rejects such taps and divides by the sum of the weights that are left
            (0 where that sum is 0), so that the result is a weighted mean everywhere.

    Returns:
        ``(B, C, H, W)`` in the dtype of ``image``. Half precision is summed in float32. Holds while the sum of
        ``|kernel image|`` is below the largest number; with ``"renormalize"``, also for the gradient, where the sum of
        the weights is 0 or between 1e-15 and 1e15.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: shapes disagree, ``K`` is even, or ``border`` is unknown.

    Differentiable in ``image`` and ``kernel``, to any order; second derivatives are computed in plain torch. Memory
    beyond the result is at most a padded copy of ``image``.

    Source: the paper's Eq. 4; Bako et al. 2017, "Kernel-predicting convolutional networks for denoising Monte Carlo
    renderings", Eq. 9.

    Example:
        >>> image = torch.arange(12.0).reshape(1, 1, 3, 4)
        >>> box = torch.full((1, 9, 3, 4), 1 / 9)
        >>> kernel_conv(image, box)[0, 0, 1, 1].item()
        5.0
    """
    kernel_size = kernel_size_of(kernel.shape[1], "kernel")
    radius = kernel_size // 2
    if border != "renormalize":
        return _Gather.of(pad(image, radius, border), kernel)
    # The mean of a few large values fits where their sum does not, and the gradient where its two terms do not.
    kernel = kernel.to(accumulator_dtype(kernel.dtype))
    total = _Gather.of(pad(image.to(accumulator_dtype(image.dtype)), radius, border), kernel)
    return _renormalized(total, kernel, kernel_size).to(image.dtype)


@op("numba", check=_check, differentiable=True)
def kernel_splat(image: Tensor, kernel: Tensor, *, border: Border = "replicate") -> Tensor:
    """Spread every pixel over its neighbours with a kernel of its own: the transpose of :func:`kernel_conv`.

    ``out[q] = sum_t kernel[t, q - o_t] * image[q - o_t]``, so that for any two images and every border mode
    ``<kernel_conv(x, k), y> = <x, kernel_splat(y, k)>``.

    Args:
        image: ``(B, C, H, W)``, any unit and range.
        kernel: ``(B, K*K, H, W)`` weights, odd ``K``: tap ``t`` of pixel ``p`` says how much of ``p`` goes to
            ``p + o_t``.
        border: where light goes that leaves the image: ``"replicate"`` to the nearest edge pixel, ``"zeros"``
            nowhere; ``"renormalize"`` first divides each pixel's weights by the sum of those inside the image, so
            that all of every pixel stays inside.

    Returns:
        ``(B, C, H, W)`` in the dtype of ``image``. Half precision is summed in float32. Holds in the range of
        :func:`kernel_conv`.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: shapes disagree, ``K`` is even, or ``border`` is unknown.

    Differentiable in ``image`` and ``kernel``, to any order; second derivatives are computed in plain torch.

    Source: Gharbi et al. 2019, "Sample-based Monte Carlo denoising using a kernel-splatting network", Eq. 3.

    Example:
        >>> image = torch.zeros(1, 1, 3, 3)
        >>> image[0, 0, 1, 1] = 9.0
        >>> kernel_splat(image, torch.full((1, 9, 3, 3), 1 / 9)).flatten().tolist()
        [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0]
    """
    kernel_size = kernel_size_of(kernel.shape[1], "kernel")
    radius = kernel_size // 2
    source = image.to(accumulator_dtype(image.dtype))
    if border == "renormalize":
        kernel = kernel.to(accumulator_dtype(kernel.dtype))
        source = _renormalized(source, kernel, kernel_size)
    return unpad(_Splat.of(source, kernel), radius, border).to(image.dtype)


KernelConv = module_of("KernelConv", kernel_conv, check_border)
KernelSplat = module_of("KernelSplat", kernel_splat, check_border)


def _renormalized(values: Tensor, kernel: Tensor, kernel_size: int) -> Tensor:
    """``values`` over the sum of the weights whose taps are inside the image; 0 where that sum is 0."""
    mask = inside(kernel.shape[-2], kernel.shape[-1], kernel_size, kernel.device)
    total = torch.where(mask, kernel, 0).sum(1, keepdim=True).to(values.dtype)
    empty = total == 0
    # Divided, because the reciprocal of a very small sum is infinite.
    return torch.where(empty, 0, values / torch.where(empty, 1, total))


# Gather, splat and correlate are the three bilinear maps of one trilinear form, sum_{t,p,c} k[t,p] y[c,p] x[c,p+o_t]:
# the derivatives of each are the other two, and its tangent is that of its arguments in turn. As loops over the taps
# with these derivatives, none of them ever holds K*K copies of the image, and gradients of any order come for free.


def _tangent(
    function: type[Function], arguments: tuple[Tensor, Tensor], tangents: tuple[Tensor | None, Tensor | None]
) -> Tensor:
    """The tangent of a bilinear map."""
    of_first, of_second = tangents
    if of_first is None:
        assert of_second is not None
        return function.of(arguments[0], of_second)
    moved = function.of(of_first, arguments[1])
    return moved if of_second is None else moved + function.of(arguments[0], of_second)


class _Gather(Function):
    @staticmethod
    def forward(padded: Tensor, kernel: Tensor) -> Tensor:
        kernel_size = kernel_size_of(kernel.shape[1], "kernel")
        height, width = kernel.shape[-2:]
        dtype = accumulator_dtype(padded.dtype)
        source = padded.to(dtype)
        total = source.new_zeros(*padded.shape[:2], height, width)
        for tap, dy, dx in offsets(kernel_size):
            total.addcmul_(kernel[:, tap : tap + 1].to(dtype), shifted(source, kernel_size // 2, dy, dx, height, width))
        return total.to(padded.dtype)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    def tangent(ctx: Any, of_padded: Tensor | None, of_kernel: Tensor | None) -> Tensor:
        return _tangent(_Gather, ctx.saved_tensors, (of_padded, of_kernel))

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None]:
        padded, kernel = ctx.saved_tensors
        to_image = _Splat.of(gradient, kernel) if ctx.needs_input_grad[0] else None
        to_kernel = _Correlate.of(gradient, padded).to(kernel.dtype) if ctx.needs_input_grad[1] else None
        return to_image, to_kernel


class _Splat(Function):
    @staticmethod
    def forward(image: Tensor, kernel: Tensor) -> Tensor:
        kernel_size = kernel_size_of(kernel.shape[1], "kernel")
        radius = kernel_size // 2
        height, width = kernel.shape[-2:]
        dtype = accumulator_dtype(image.dtype)
        source = image.to(dtype)
        total = source.new_zeros(*image.shape[:2], height + 2 * radius, width + 2 * radius)
        for tap, dy, dx in offsets(kernel_size):
            shifted(total, radius, dy, dx, height, width).addcmul_(kernel[:, tap : tap + 1].to(dtype), source)
        return total.to(image.dtype)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    def tangent(ctx: Any, of_image: Tensor | None, of_kernel: Tensor | None) -> Tensor:
        return _tangent(_Splat, ctx.saved_tensors, (of_image, of_kernel))

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None]:
        image, kernel = ctx.saved_tensors
        to_image = _Gather.of(gradient, kernel) if ctx.needs_input_grad[0] else None
        to_kernel = _Correlate.of(image, gradient).to(kernel.dtype) if ctx.needs_input_grad[1] else None
        return to_image, to_kernel


class _Correlate(Function):
    @staticmethod
    def forward(image: Tensor, padded: Tensor) -> Tensor:
        height, width = image.shape[-2:]
        radius = (padded.shape[-2] - height) // 2
        kernel_size = 2 * radius + 1
        dtype = accumulator_dtype(image.dtype)
        source, other = image.to(dtype), padded.to(dtype)
        result = source.new_empty(image.shape[0], kernel_size * kernel_size, height, width)
        for tap, dy, dx in offsets(kernel_size):
            result[:, tap] = (source * shifted(other, radius, dy, dx, height, width)).sum(1)
        return result

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)

    @staticmethod
    def tangent(ctx: Any, of_image: Tensor | None, of_padded: Tensor | None) -> Tensor:
        return _tangent(_Correlate, ctx.saved_tensors, (of_image, of_padded))

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, Tensor | None]:
        image, padded = ctx.saved_tensors
        to_image = _Gather.of(padded, gradient) if ctx.needs_input_grad[0] else None
        to_padded = _Splat.of(image, gradient) if ctx.needs_input_grad[1] else None
        return to_image, to_padded
