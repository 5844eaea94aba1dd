"""The filters of a backend as torch operators with derivatives; each backend has the kernels in its ``_filter``.

An operator takes the arguments of its op, one after the other. Its gradients take which arguments need one, the
gradient of the result and the arguments, and return one for each argument.
"""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from mcdenoise.ops._operator import Operator

Gradients = Callable[..., tuple[Any, ...]]

_KERNEL = "Tensor image, Tensor kernel, str border"
_FILTER = (
    "Tensor image, Tensor kernel, Tensor[] guides, Tensor[] falloffs, Tensor? distance_falloff, str normalize, "
    "str border"
)


class KernelOperators(NamedTuple):
    """Kernel convolution and its transpose."""

    conv: Operator
    conv_gradients: Gradients
    splat: Operator
    splat_gradients: Gradients


def kernel_operators(backend: str, filters: ModuleType) -> KernelOperators:
    """Kernel convolution and its transpose by the filters of a backend."""

    def convolve(image: Tensor, kernel: Tensor, border: str) -> Tensor:
        result: Tensor = filters.filtered(image, kernel, (), (), None, False, border)
        return result

    def spread(image: Tensor, kernel: Tensor, border: str) -> Tensor:
        result: Tensor = filters.splatted(image, kernel, border)
        return result

    def differentiate(gradient: Tensor, image: Tensor, kernel: Tensor, border: str) -> tuple[Tensor, Tensor]:
        of_image, of_kernel, *_ = filters.derivatives(gradient, image, kernel, (), (), None, False, border)
        return of_image, of_kernel

    conv = Operator(f"mcdenoise::{backend}_kernel_conv", convolve, None, f"({_KERNEL}) -> Tensor")
    splat = Operator(f"mcdenoise::{backend}_kernel_splat", spread, None, f"({_KERNEL}) -> Tensor")
    # Both are bilinear maps of one trilinear form, <y, kernel_conv(x, k)> = <kernel_splat(y, k), x>, and its derivative
    # in the kernel is the same whichever of the two images is called the gradient.
    backward = Operator(
        f"mcdenoise::{backend}_kernel_conv_backward",
        differentiate,
        None,
        f"(Tensor gradient, {_KERNEL}) -> (Tensor, Tensor)",
    )
    for operator in (conv, splat):
        operator.register_fake(lambda image, kernel, border: image.new_empty(image.shape))
    backward.register_fake(
        lambda gradient, image, kernel, border: (image.new_empty(image.shape), torch.empty_like(kernel))
    )

    def conv_gradients(needed: tuple[Any, ...], gradient: Tensor, *arguments: Any) -> tuple[Any, ...]:
        return (*backward(gradient, *arguments), None)

    def splat_gradients(
        needed: tuple[Any, ...], gradient: Tensor, image: Tensor, kernel: Tensor, border: str
    ) -> tuple[Any, ...]:
        of_image = conv(gradient, kernel, border) if needed[0] else None
        return of_image, backward(image, gradient, kernel, border)[1] if needed[1] else None, None

    return KernelOperators(conv, conv_gradients, splat, splat_gradients)


def filter_operator(backend: str, filters: ModuleType) -> tuple[Operator, Gradients]:
    """The cross-bilateral filter by the filters of a backend."""

    def run(
        image: Tensor,
        kernel: Tensor,
        guides: list[Tensor],
        falloffs: list[Tensor],
        distance_falloff: Tensor | None,
        normalize: str,
        border: str,
    ) -> Tensor:
        in_log_domain = normalize == "softmax"
        result: Tensor = filters.filtered(image, kernel, guides, falloffs, distance_falloff, in_log_domain, border)
        return result

    def differentiate(
        gradient: Tensor,
        image: Tensor,
        kernel: Tensor,
        guides: list[Tensor],
        falloffs: list[Tensor],
        distance_falloff: Tensor | None,
        normalize: str,
        border: str,
        of_guides: bool,
    ) -> list[Tensor]:
        of_image, of_kernel, of_guide, of_falloff, of_distance = filters.derivatives(
            gradient, image, kernel, guides, falloffs, distance_falloff, normalize == "softmax", border, of_guides
        )
        return [of_image, of_kernel, *of_falloff, of_distance, *of_guide]

    def empty(
        gradient: Tensor,
        image: Tensor,
        kernel: Tensor,
        guides: list[Tensor],
        falloffs: list[Tensor],
        distance_falloff: Tensor | None,
        normalize: str,
        border: str,
        of_guides: bool,
    ) -> list[Tensor]:
        nothing = image.new_empty((image.shape[0], 0, *image.shape[2:]))
        return [
            image.new_empty(image.shape),
            torch.empty_like(kernel),
            *(falloff.new_empty(falloff.shape) for falloff in falloffs),
            nothing if distance_falloff is None else distance_falloff.new_empty(distance_falloff.shape),
            *(guide.new_empty(guide.shape) for guide in guides if of_guides),
        ]

    forward = Operator(f"mcdenoise::{backend}_cross_bilateral_filter", run, None, f"({_FILTER}) -> Tensor")
    forward.register_fake(lambda image, *_: image.new_empty(image.shape))
    backward = Operator(
        f"mcdenoise::{backend}_cross_bilateral_filter_backward",
        differentiate,
        None,
        f"(Tensor gradient, {_FILTER}, bool of_guides) -> Tensor[]",
    )
    backward.register_fake(empty)

    def gradients(needed: tuple[Any, ...], gradient: Tensor, *arguments: Any) -> tuple[Any, ...]:
        count, distance_falloff = len(arguments[2]), arguments[4]
        of_image, of_kernel, *others = backward(gradient, *arguments, any(needed[2]))
        of_scales, of_distance, of_guides = others[:count], others[count], others[count + 1 :]
        to_distance = None if distance_falloff is None else of_distance
        return of_image, of_kernel, of_guides or [None] * count, of_scales, to_distance, None, None

    return forward, gradients
