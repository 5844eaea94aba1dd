"""Cross-bilateral weights over any guides."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor, nn

from mcdenoise.ops._autograd import Function
from mcdenoise.ops._check import check_shapes
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
    scales: Sequence[Tensor] = (),
    distance_scale: Tensor | None = None,
    *,
    normalize: Normalize = "softmax",
    border: Border = "replicate",
) -> Tensor:
    """Turn per-pixel kernels into weights that fall off where guides differ, for :func:`kernel_conv`.

    With ``E[t, p] = sum_g f_g[p] |g[p + o_t] - g[p]|^2 + f_d[p] |o_t|^2``, the squared Euclidean distance over the
    channels of each guide and over the pixel offset:

    - ``normalize="none"``: ``w'[t, p] = w[t, p] exp(-E[t, p])``, the paper's Eqs. 5-8 to the letter;
    - ``normalize="softmax"``: ``w'[:, p] = softmax_t(logit[t, p] - E[t, p])``, the same with ``w = exp(logit)``,
      normalised, and computed in the log domain, where no scale can overflow or leave a sum of zero.

    Args:
        kernel: ``(B, K*K, H, W)``, odd ``K``, taps row by row from top left: weights ``w`` for ``"none"``, logits
            for ``"softmax"``. A plain cross-bilateral filter has ones, respectively zeros.
        guides: any number of ``(B, C_g, H, W)`` feature images, any channels and unit.
        scales: one ``(B, 1, H, W)`` per guide, the ``f_g >= 0`` (1 / guide unit squared).
        distance_scale: ``(B, 1, H, W)``, the ``f_d >= 0`` (1 / pixel squared); ``None`` leaves the term out.
        normalize: ``"softmax"`` or ``"none"``.
        border: what a tap outside the image sees: ``"replicate"`` the guide's nearest edge pixel, ``"zeros"`` a guide
            of zeros; ``"renormalize"`` gives such taps the weight 0.

    Returns:
        ``(B, K*K, H, W)`` weights in the dtype of ``kernel``; with ``"softmax"`` non-negative, summing to one.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: shapes disagree, ``K`` is even, the numbers of guides and scales differ, or a mode is unknown.

    Differentiable in ``kernel``, ``guides``, ``scales`` and ``distance_scale``, to any order. Half precision sums
    the exponent in float32.

    Source: the paper's Eqs. 5-8; Eisemann and Durand 2004, Petschnigg et al. 2004 (cross/joint bilateral filter).

    Example:
        >>> guide = torch.tensor([0.0, 0.0, 1.0]).reshape(1, 1, 1, 3)
        >>> weights = cross_bilateral_weights(torch.zeros(1, 9, 1, 3), [guide], [torch.full((1, 1, 1, 3), 1e8)],
        ...                                   border="renormalize")
        >>> weights[0, 3:6, 0, 1].tolist()  # left, centre, right of the middle pixel
        [0.5, 0.5, 0.0]
    """
    kernel_size = _check(kernel, guides, scales, distance_scale, normalize, border)
    radius = kernel_size // 2
    log_domain = normalize == "softmax"
    margins = [pad(guide, radius, border) for guide in guides]
    start = kernel if log_domain else torch.zeros_like(kernel)
    exponent = _Exponent.apply(start, distance_scale, radius, *margins, *scales)
    if border == "renormalize":
        mask = inside(kernel.shape[-2], kernel.shape[-1], kernel_size, kernel.device)
        exponent = torch.where(mask, exponent, -torch.inf)
    weights = torch.softmax(exponent, 1) if log_domain else kernel * torch.exp(exponent)
    return weights.to(kernel.dtype)


class CrossBilateralWeights(nn.Module):
    """:func:`cross_bilateral_weights` with its modes stored.

    Args:
        normalize: see :func:`cross_bilateral_weights`.
        border: see :func:`cross_bilateral_weights`.
    """

    def __init__(self, normalize: Normalize = "softmax", border: Border = "replicate") -> None:
        super().__init__()
        _check_normalize(normalize)
        check_border(border)
        self.normalize: Normalize = normalize
        self.border: Border = border

    def forward(
        self,
        kernel: Tensor,
        guides: Sequence[Tensor] = (),
        scales: Sequence[Tensor] = (),
        distance_scale: Tensor | None = None,
    ) -> Tensor:
        """See :func:`cross_bilateral_weights`."""
        return cross_bilateral_weights(
            kernel, guides, scales, distance_scale, normalize=self.normalize, border=self.border
        )


def _check_normalize(normalize: str) -> None:
    if normalize not in ("softmax", "none"):
        raise ValueError(f"normalize: expected 'softmax' or 'none', found {normalize!r}")


def _check(
    kernel: Tensor,
    guides: Sequence[Tensor],
    scales: Sequence[Tensor],
    distance_scale: Tensor | None,
    normalize: str,
    border: str,
) -> int:
    if len(guides) != len(scales):
        raise ValueError(f"scales: expected one for each of the {len(guides)} guides, found {len(scales)}")
    arguments = {"kernel": (kernel, "B T H W")}
    for i, (guide, scale) in enumerate(zip(guides, scales, strict=True)):
        arguments[f"guides[{i}]"] = (guide, f"B C{i} H W")
        arguments[f"scales[{i}]"] = (scale, "B 1 H W")
    if distance_scale is not None:
        arguments["distance_scale"] = (distance_scale, "B 1 H W")
    sizes = check_shapes(**arguments)
    _check_normalize(normalize)
    check_border(border)
    return kernel_size_of(sizes["T"], "kernel")


class _Exponent(Function):
    """``kernel - sum_g f_g |difference of g|^2 - f_d |offset|^2`` in one pass over the taps, with no stack of them."""

    @staticmethod
    def forward(kernel: Tensor, distance_scale: Tensor | None, radius: int, *rest: Tensor) -> Tensor:
        height, width = kernel.shape[-2:]
        dtype = accumulator_dtype(kernel.dtype)
        guides, scales = _split(rest, dtype)
        distance = None if distance_scale is None else distance_scale.to(dtype)
        result = kernel.to(dtype, copy=True)
        for tap, dy, dx in offsets(2 * radius + 1):
            out = result[:, tap : tap + 1]
            if dy == 0 and dx == 0:
                continue
            for padded, scale in zip(guides, scales, strict=True):
                out.addcmul_(scale, _squared_distance(padded, radius, dy, dx, height, width), value=-1)
            if distance is not None:
                out.sub_(distance, alpha=dy * dy + dx * dx)
        return result

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Tensor) -> None:
        kernel, distance_scale, radius, *rest = inputs
        ctx.radius, ctx.has_distance, ctx.dtypes = radius, distance_scale is not None, [x.dtype for x in rest]
        ctx.kernel_dtype = kernel.dtype
        ctx.distance_dtype = None if distance_scale is None else distance_scale.dtype
        ctx.save_for_backward(*rest)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:
        # Plain differentiable torch: recorded only when a second derivative is asked for.
        radius = ctx.radius
        height, width = gradient.shape[-2:]
        guides, scales = _split(ctx.saved_tensors, gradient.dtype)
        n = len(guides)
        need_guide, need_scale = ctx.needs_input_grad[3 : 3 + n], ctx.needs_input_grad[3 + n :]
        to_guides: list[Tensor | None] = []
        to_scales: list[Tensor | None] = []
        for padded, scale, for_guide, for_scale in zip(guides, scales, need_guide, need_scale, strict=True):
            to_guides.append(_guide_gradient(gradient, padded, scale, radius) if for_guide else None)
            total = torch.zeros_like(scale) if for_scale else None
            if total is not None:
                for tap, dy, dx in offsets(2 * radius + 1):
                    distance = _squared_distance(padded, radius, dy, dx, height, width)
                    total = torch.addcmul(total, gradient[:, tap : tap + 1], distance, value=-1)
            to_scales.append(total)
        to_distance = None
        if ctx.has_distance and ctx.needs_input_grad[1]:
            squares = torch.tensor([dy * dy + dx * dx for _, dy, dx in offsets(2 * radius + 1)], dtype=gradient.dtype)
            to_distance = -torch.einsum("bthw,t->bhw", gradient, squares.to(gradient.device)).unsqueeze(1)
            to_distance = to_distance.to(ctx.distance_dtype)
        out = [None if g is None else g.to(t) for g, t in zip(to_guides + to_scales, ctx.dtypes, strict=True)]
        return gradient.to(ctx.kernel_dtype), to_distance, None, *out


def _split(rest: Sequence[Tensor], dtype: torch.dtype) -> tuple[list[Tensor], list[Tensor]]:
    tensors = [tensor.to(dtype) for tensor in rest]
    return tensors[: len(tensors) // 2], tensors[len(tensors) // 2 :]


def _squared_distance(padded: Tensor, radius: int, dy: int, dx: int, height: int, width: int) -> Tensor:
    centre = shifted(padded, radius, 0, 0, height, width)
    difference = shifted(padded, radius, dy, dx, height, width) - centre
    return difference.square().sum(1, keepdim=True)


def _guide_gradient(gradient: Tensor, padded: Tensor, scale: Tensor, radius: int) -> Tensor:
    """Each tap pulls the neighbour one way and the centre the other."""
    height, width = gradient.shape[-2:]
    total = torch.zeros_like(padded)
    centre_total = torch.zeros_like(shifted(padded, radius, 0, 0, height, width))
    centre = shifted(padded, radius, 0, 0, height, width)
    for tap, dy, dx in offsets(2 * radius + 1):
        difference = shifted(padded, radius, dy, dx, height, width) - centre
        pull = (-2 * gradient[:, tap : tap + 1] * scale) * difference
        shifted(total, radius, dy, dx, height, width).add_(pull)
        centre_total = centre_total - pull
    shifted(total, radius, 0, 0, height, width).add_(centre_total)
    return total
