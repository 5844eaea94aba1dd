"""The fast form of the cross-bilateral filter as a torch operator."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from mcdenoise.ops._fast._filter import filter_of
from mcdenoise.ops._fast._operator import custom_op
from mcdenoise.ops._fast._plain import plain_gradients
from mcdenoise.ops.bilateral_filter import cross_bilateral_filter_torch

_ARGUMENTS = (
    "Tensor image, Tensor kernel, Tensor[] guides, Tensor[] scales, Tensor? distance_scale, str normalize, str border, "
    "str backend"
)


@custom_op("mcdenoise::cross_bilateral_filter", schema=f"({_ARGUMENTS}) -> Tensor")
def cross_bilateral_filter(
    image: Tensor,
    kernel: Tensor,
    guides: list[Tensor],
    scales: list[Tensor],
    distance_scale: Tensor | None,
    normalize: str,
    border: str,
    backend: str,
) -> Tensor:
    """See :func:`mcdenoise.ops.cross_bilateral_filter`."""
    result: Tensor = filter_of(backend).filtered(
        image, kernel, guides, scales, distance_scale, normalize == "softmax", border
    )
    return result


@cross_bilateral_filter.register_fake
def _(image: Tensor, *_: Any) -> Tensor:
    return image.new_empty(image.shape)


@custom_op(
    "mcdenoise::cross_bilateral_filter_backward",
    schema=f"(Tensor gradient, {_ARGUMENTS}, bool of_guides) -> Tensor[]",
)
def _backward(
    gradient: Tensor,
    image: Tensor,
    kernel: Tensor,
    guides: list[Tensor],
    scales: list[Tensor],
    distance_scale: Tensor | None,
    normalize: str,
    border: str,
    backend: str,
    of_guides: bool,
) -> list[Tensor]:
    of_image, of_kernel, of_guide, of_scale, of_distance = filter_of(backend).derivatives(
        gradient, image, kernel, guides, scales, distance_scale, normalize == "softmax", border, of_guides
    )
    return [of_image, of_kernel, *of_scale, of_distance, *of_guide]


@_backward.register_fake
def _(
    gradient: Tensor,
    image: Tensor,
    kernel: Tensor,
    guides: list[Tensor],
    scales: list[Tensor],
    distance_scale: Tensor | None,
    normalize: str,
    border: str,
    backend: str,
    of_guides: bool,
) -> list[Tensor]:
    batch, _, height, width = image.shape
    return [
        image.new_empty(image.shape),
        torch.empty_like(kernel),
        *(scale.new_empty(scale.shape) for scale in scales),
        image.new_empty((batch, 0, height, width))
        if distance_scale is None
        else distance_scale.new_empty(distance_scale.shape),
        *(guide.new_empty(guide.shape) for guide in guides if of_guides),
    ]


def _setup_context(ctx: Any, inputs: Any, output: Tensor) -> None:
    image, kernel, guides, scales, distance_scale, ctx.normalize, ctx.border, ctx.backend = inputs
    ctx.count = len(guides)
    ctx.save_for_backward(image, kernel, distance_scale, *guides, *scales)


def _gradients(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:
    image, kernel, distance_scale, *others = ctx.saved_tensors
    count = ctx.count
    guides, scales = others[:count], others[count:]
    need_image, need_kernel, need_guides, need_scales, need_distance, *_ = ctx.needs_input_grad
    if torch.is_grad_enabled():

        def plain(image: Tensor, kernel: Tensor, distance_scale: Tensor | None, *others: Tensor) -> Tensor:
            return cross_bilateral_filter_torch(
                image, kernel, others[:count], others[count:], distance_scale, ctx.normalize, ctx.border
            )

        needed = [need_image, need_kernel, need_distance, *need_guides, *need_scales]
        of_image, of_kernel, of_distance, *rest = plain_gradients(
            plain, [image, kernel, distance_scale, *others], needed, gradient
        )
        return of_image, of_kernel, rest[:count], rest[count:], of_distance, None, None, None
    results = _backward(
        gradient,
        image,
        kernel,
        guides,
        scales,
        distance_scale,
        ctx.normalize,
        ctx.border,
        ctx.backend,
        any(need_guides),
    )
    of_image, of_kernel, of_scales, of_distance = results[0], results[1], results[2 : 2 + count], results[2 + count]
    of_guides = results[3 + count :] or [None] * count
    to_distance = None if distance_scale is None else of_distance
    return of_image, of_kernel, of_guides, of_scales, to_distance, None, None, None


cross_bilateral_filter.register_autograd(_gradients, setup_context=_setup_context)
