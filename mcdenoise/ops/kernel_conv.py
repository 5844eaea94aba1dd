"""Per-pixel kernel convolution (gather) and its transpose (splat)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

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
    taps,
    unpad,
)


def _check(kernel: Tensor, border: str) -> None:
    check_border(border)
    kernel_size_of(kernel.shape[1], "kernel")


@op("numba", check=_check, image="B C H W", kernel="B T H W")
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

    Differentiable in ``image`` and ``kernel``, to any order. Memory beyond the result is at most a padded copy of
    ``image``.

    Source: the paper's Eq. 4; Bako et al. 2017, "Kernel-predicting convolutional networks for denoising Monte Carlo
    renderings", Eq. 9.

    Example:
        >>> image = torch.arange(12.0).reshape(1, 1, 3, 4)
        >>> box = torch.full((1, 9, 3, 4), 1 / 9)
        >>> kernel_conv(image, box)[0, 0, 1, 1].item()
        5.0
    """
    kernel_size = kernel_size_of(kernel.shape[1], "kernel")
    dtype = accumulator_dtype(image.dtype)
    source = image.to(dtype)
    if border == "renormalize":
        # Once: the two terms of its gradient may cancel, and are too large for half precision.
        kernel = kernel.to(accumulator_dtype(kernel.dtype))
    total = torch.zeros_like(source)
    for weight, tap in zip(kernel.split(1, 1), taps(source, kernel_size, border), strict=True):
        total = total + weight.to(dtype) * tap
    if border == "renormalize":
        # The mean of a few large values fits where their sum does not.
        total = _renormalized(total, kernel, kernel_size)
    return total.to(image.dtype)


@op(check=_check, image="B C H W", kernel="B T H W")
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

    Differentiable in ``image`` and ``kernel``, to any order.

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
        # Once: the two terms of its gradient may cancel, and are too large for half precision.
        kernel = kernel.to(accumulator_dtype(kernel.dtype))
        source = _renormalized(source, kernel, kernel_size)
    total = pad(torch.zeros_like(source), radius, "zeros")
    for weight, (_, dy, dx) in zip(kernel.split(1, 1), offsets(kernel_size), strict=True):
        margin = radius + dx, radius - dx, radius + dy, radius - dy
        total = total + F.pad(weight.to(source.dtype) * source, margin)
    return unpad(total, radius, border).to(image.dtype)


KernelConv = module_of(kernel_conv, check_border)
KernelSplat = module_of(kernel_splat, check_border)


def _renormalized(values: Tensor, kernel: Tensor, kernel_size: int) -> Tensor:
    """``values`` over the sum of the weights whose taps are inside the image; 0 where that sum is 0."""
    mask = inside(kernel, kernel_size)
    total = torch.where(mask, kernel, 0).sum(1, keepdim=True).to(values.dtype)
    empty = total == 0
    # Divided, because the reciprocal of a very small sum is infinite.
    return torch.where(empty, 0, values / torch.where(empty, 1, total))
