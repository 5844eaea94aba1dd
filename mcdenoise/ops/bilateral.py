"""Cross-bilateral weights over any guides."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from mcdenoise.ops._autograd import Function
from mcdenoise.ops._check import check_shapes
from mcdenoise.ops._guides import padded_gradient, squared_distance
from mcdenoise.ops._module import module_of
from mcdenoise.ops._window import (
    Border,
    accumulator_dtype,
    check_border,
    inside,
    kernel_size_of,
    offsets,
    pad,
    shifted,
)

Normalize = Literal["softmax", "none"]


def cross_bilateral_weights(
    kernel: Tensor,
    guides: Sequence[Tensor] = (),
    falloffs: Sequence[Tensor] = (),
    distance_falloff: Tensor | None = None,
    *,
    normalize: Normalize = "softmax",
    border: Border = "replicate",
) -> Tensor:
    """Turn per-pixel kernels into weights that fall off where guides differ, for :func:`kernel_conv`.

    With ``E[t, p] = sum_g f_g[p] |g[p + o_t] - g[p]|^2 + f_d[p] |o_t|^2``, the squared Euclidean distance over the
    channels of each guide and over the pixel offset:

    - ``normalize="none"``: ``w'[t, p] = w[t, p] exp(-E[t, p])``, the paper's Eqs. 5-8 to the letter;
    - ``normalize="softmax"``: ``w'[:, p] = softmax_t(logit[t, p] - E[t, p])``, the same with ``w = exp(logit)``,
      normalised, and computed in the log domain, where no falloff can overflow or leave a sum of zero.

    Args:
        kernel: ``(B, K*K, H, W)``, odd ``K``, taps row by row from top left: weights ``w`` for ``"none"``, logits
            for ``"softmax"``. A cross-bilateral filter without predicted kernels has ones, respectively zeros. A logit
            may be infinite, and gives the limit of a large one.
        guides: any number of ``(B, C_g, H, W)`` feature images, any channels and unit, finite, at most 1e15.
        falloffs: one ``(B, 1, H, W)`` per guide, the ``f_g >= 0`` (1 / guide unit squared), at most 1e8.
        distance_falloff: ``(B, 1, H, W)``, the ``f_d >= 0`` (1 / pixel squared); ``None`` omits the term.
        normalize: ``"softmax"`` or ``"none"``.
        border: guide at a tap outside the image: ``"replicate"`` that of the nearest edge pixel, ``"zeros"`` a guide
            of zeros; ``"renormalize"`` gives such taps the weight 0.

    Returns:
        ``(B, K*K, H, W)`` weights in the dtype of ``kernel``; with ``"softmax"`` non-negative, summing to one.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: shapes disagree, ``K`` is even, the numbers of guides and falloffs differ, or a mode is unknown.

    Differentiable in ``kernel``, ``guides``, ``falloffs`` and ``distance_falloff``, to any order. Half precision sums
    the exponent in float32. A weight is known to eps times its exponent ``|logit| + E``.

    Source: the paper's Eqs. 5-8; Eisemann and Durand 2004, Petschnigg et al. 2004 (cross/joint bilateral filter).

    Example:
        >>> guide = torch.tensor([0.0, 0.0, 1.0]).reshape(1, 1, 1, 3)
        >>> weights = cross_bilateral_weights(torch.zeros(1, 9, 1, 3), [guide], [torch.full((1, 1, 1, 3), 1e8)],
        ...                                   border="renormalize")
        >>> weights[0, 3:6, 0, 1].tolist()  # left, centre, right of the middle pixel
        [0.5, 0.5, 0.0]
    """
    kernel_size = check_weights(kernel, guides, falloffs, distance_falloff, normalize, border)
    radius = kernel_size // 2
    log_domain = normalize == "softmax"
    start = kernel if log_domain else torch.zeros_like(kernel)
    exponent = _exponent(start, guides, falloffs, distance_falloff, radius, border)
    if log_domain:
        if border == "renormalize":
            exponent = torch.where(_inside(kernel, kernel_size), exponent, -torch.inf)
        weights = torch.softmax(exponent, 1)
    else:
        weights = kernel * torch.exp(exponent)
        if border == "renormalize":
            weights = torch.where(_inside(kernel, kernel_size), weights, 0)
    return weights.to(kernel.dtype)


def _inside(kernel: Tensor, kernel_size: int) -> Tensor:
    return inside(kernel.shape[-2], kernel.shape[-1], kernel_size, kernel.device)


def check_normalize(normalize: str) -> None:
    """``ValueError`` for an unknown normalisation."""
    if normalize not in ("softmax", "none"):
        raise ValueError(f"normalize: expected 'softmax' or 'none', found {normalize!r}")


def check_settings(normalize: str, border: str) -> None:
    """``ValueError`` for an unknown mode."""
    check_normalize(normalize)
    check_border(border)


CrossBilateralWeights = module_of("CrossBilateralWeights", cross_bilateral_weights, check_settings)


def check_weights(
    kernel: Tensor,
    guides: Sequence[Tensor],
    falloffs: Sequence[Tensor],
    distance_falloff: Tensor | None,
    normalize: str,
    border: str,
) -> int:
    """The kernel size of arguments that :func:`cross_bilateral_weights` accepts; its errors for others."""
    if len(guides) != len(falloffs):
        raise ValueError(f"falloffs: expected one for each of the {len(guides)} guides, found {len(falloffs)}")
    arguments = {"kernel": (kernel, "B T H W")}
    for i, (guide, falloff) in enumerate(zip(guides, falloffs, strict=True)):
        arguments[f"guides[{i}]"] = (guide, f"B C{i} H W")
        arguments[f"falloffs[{i}]"] = (falloff, "B 1 H W")
    if distance_falloff is not None:
        arguments["distance_falloff"] = (distance_falloff, "B 1 H W")
    sizes = check_shapes(**arguments)
    check_normalize(normalize)
    check_border(border)
    return kernel_size_of(sizes["T"], "kernel")


def _exponent(
    start: Tensor,
    guides: Sequence[Tensor],
    falloffs: Sequence[Tensor],
    distance_falloff: Tensor | None,
    radius: int,
    border: Border,
) -> Tensor:
    """``start - sum_g f_g |difference of g|^2 - f_d |offset|^2``, in the dtype in which sums are kept."""
    dtype = accumulator_dtype(start.dtype)
    channels = tuple(guide.shape[1] for guide in guides)
    # One tensor for all guides: torch.compile takes no function with a variable number of arguments.
    margin = pad(torch.cat([guide.to(dtype) for guide in guides], 1), radius, border) if guides else None
    factors = torch.cat([falloff.to(dtype) for falloff in falloffs], 1) if falloffs else None
    distance = None if distance_falloff is None else distance_falloff.to(dtype)
    return _Exponent.of(start, distance, margin, factors, channels, radius)


class _Exponent(Function):
    """:func:`_exponent` of padded, concatenated guides in one pass over the taps, with no stack of them."""

    @staticmethod
    def forward(
        start: Tensor,
        distance_falloff: Tensor | None,
        guides: Tensor | None,
        falloffs: Tensor | None,
        channels: tuple[int, ...],
        radius: int,
    ) -> Tensor:
        height, width = start.shape[-2:]
        # One plane after the other, whatever the layout of the kernel: every tap is updated on its own. The copy that
        # this takes makes infinite logits finite, so that the weight of each of two of them is not NaN, but half.
        dtype = accumulator_dtype(start.dtype)
        largest = torch.finfo(dtype).max
        result = start.to(dtype, memory_format=torch.contiguous_format).clamp(-largest, largest)
        for tap, dy, dx in offsets(2 * radius + 1):
            out = result[:, tap : tap + 1]
            if dy == 0 and dx == 0:
                continue
            for padded, falloff in _each(guides, falloffs, channels):
                out.addcmul_(falloff, squared_distance(padded, radius, dy, dx, height, width), value=-1)
            if distance_falloff is not None:
                out.sub_(distance_falloff, alpha=dy * dy + dx * dx)
        return result

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Tensor) -> None:
        start, _, guides, falloffs, ctx.channels, ctx.radius = inputs
        ctx.dtype = start.dtype
        ctx.save_for_backward(guides, falloffs)
        ctx.save_for_forward(guides, falloffs)

    @staticmethod
    def tangent(
        ctx: Any,
        of_start: Tensor | None,
        of_distance: Tensor | None,
        of_guides: Tensor | None,
        of_scales: Tensor | None,
        *_: None,
    ) -> Tensor:
        radius = ctx.radius
        guides, falloffs = ctx.saved_tensors
        given = next(tangent for tangent in (of_start, of_distance, of_scales, of_guides) if tangent is not None)
        margin = 2 * radius if given is of_guides else 0
        height, width = given.shape[-2] - margin, given.shape[-1] - margin
        pairs = _each(guides, falloffs, ctx.channels)
        tangents = zip(
            [None] * len(pairs) if of_guides is None else torch.split(of_guides, list(ctx.channels), 1),
            [None] * len(pairs) if of_scales is None else torch.split(of_scales, 1, 1),
            strict=True,
        )
        moving = list(zip(pairs, tangents, strict=True))
        taps = []
        for tap, dy, dx in offsets(2 * radius + 1):
            total = given.new_zeros(given.shape[0], 1, height, width, dtype=accumulator_dtype(ctx.dtype))
            if of_start is not None:
                total = total + of_start[:, tap : tap + 1]
            if of_distance is not None:
                total = total - of_distance * (dy * dy + dx * dx)
            for (padded, falloff), (of_padded, of_falloff) in moving:
                size = (height, width)
                difference = shifted(padded, radius, dy, dx, *size) - shifted(padded, radius, 0, 0, *size)
                if of_falloff is not None:
                    total = total - of_falloff * difference.square().sum(1, keepdim=True)
                if of_padded is not None:
                    change = shifted(of_padded, radius, dy, dx, *size) - shifted(of_padded, radius, 0, 0, *size)
                    total = total - 2 * falloff * (difference * change).sum(1, keepdim=True)
            taps.append(total)
        return torch.cat(taps, 1)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        # Plain differentiable torch: recorded only when a second derivative is asked for.
        radius = ctx.radius
        _, need_distance, need_guides, need_scales, *_ = ctx.needs_input_grad
        guides, falloffs = ctx.saved_tensors
        pairs = _each(guides, falloffs, ctx.channels)
        to_distance = to_guides = to_scales = None
        if need_distance:
            to_distance = torch.zeros_like(gradient[:, :1])
            for tap, dy, dx in offsets(2 * radius + 1):
                to_distance = torch.sub(to_distance, gradient[:, tap : tap + 1], alpha=dy * dy + dx * dx)
        if need_guides:
            to_guides = torch.cat([padded_gradient(gradient, padded, falloff, radius) for padded, falloff in pairs], 1)
        if need_scales:
            to_scales = torch.cat([_scale_gradient(gradient, padded, radius) for padded, _ in pairs], 1)
        return gradient.to(ctx.dtype), to_distance, to_guides, to_scales, None, None


def _each(guides: Tensor | None, falloffs: Tensor | None, channels: tuple[int, ...]) -> list[tuple[Tensor, Tensor]]:
    """Each guide with its falloff."""
    if guides is None or falloffs is None:
        return []
    return list(zip(torch.split(guides, list(channels), 1), torch.split(falloffs, 1, 1), strict=True))


def _scale_gradient(gradient: Tensor, padded: Tensor, radius: int) -> Tensor:
    height, width = gradient.shape[-2:]
    total = torch.zeros_like(gradient[:, :1])
    for tap, dy, dx in offsets(2 * radius + 1):
        distance = squared_distance(padded, radius, dy, dx, height, width)
        total = torch.addcmul(total, gradient[:, tap : tap + 1], distance, value=-1)
    return total
