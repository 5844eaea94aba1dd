"""Cross-bilateral weights over any guides."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from mcdenoise.ops._check import check_shapes
from mcdenoise.ops._distance import squared_distance
from mcdenoise.ops._module import module_of
from mcdenoise.ops._window import (
    Border,
    accumulator_dtype,
    check_border,
    inside,
    kernel_size_of,
    offsets,
    taps,
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
    log_domain = normalize == "softmax"
    start = kernel if log_domain else torch.zeros_like(kernel)
    exponent = exponent_of(start, guides, falloffs, distance_falloff, kernel_size, border)
    if log_domain:
        if border == "renormalize":
            exponent = torch.where(inside(kernel, kernel_size), exponent, -torch.inf)
        weights = torch.softmax(exponent, 1)
    else:
        weights = kernel * torch.exp(exponent)
        if border == "renormalize":
            weights = torch.where(inside(kernel, kernel_size), weights, 0)
    return weights.to(kernel.dtype)


def check_settings(normalize: str, border: str) -> None:
    """``ValueError`` for an unknown mode."""
    if normalize not in ("softmax", "none"):
        raise ValueError(f"normalize: expected 'softmax' or 'none', found {normalize!r}")
    check_border(border)


CrossBilateralWeights = module_of(cross_bilateral_weights, check_settings)


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
    arguments: dict[str, tuple[Tensor | None, str]] = {"kernel": (kernel, "B T H W")}
    arguments["distance_falloff"] = (distance_falloff, "[B 1 H W]")
    for i, (guide, falloff) in enumerate(zip(guides, falloffs, strict=True)):
        arguments[f"guides[{i}]"] = (guide, f"B C{i} H W")
        arguments[f"falloffs[{i}]"] = (falloff, "B 1 H W")
    sizes = check_shapes(**arguments)
    check_settings(normalize, border)
    return kernel_size_of(sizes["T"], "kernel")


def exponent_of(
    start: Tensor,
    guides: Sequence[Tensor],
    falloffs: Sequence[Tensor],
    distance_falloff: Tensor | None,
    kernel_size: int,
    border: Border,
) -> Tensor:
    """``start - sum_g f_g |difference of g|^2 - f_d |offset|^2``, in the dtype in which sums are kept."""
    dtype = accumulator_dtype(start.dtype)
    # Infinite logits are finite here, so that the weight of each of two of them is not NaN, but half.
    largest = torch.finfo(dtype).max
    # One plane after the other, whatever the layout of the kernel: every tap is read on its own.
    logits = start.to(dtype).contiguous().clamp(-largest, largest)
    if not guides and distance_falloff is None:
        return logits
    centres = [guide.to(dtype) for guide in guides]
    # Once, so that their gradients are summed in that dtype, too.
    scales = [falloff.to(dtype) for falloff in falloffs]
    spacing = None if distance_falloff is None else distance_falloff.to(dtype)
    moved = [taps(centre, kernel_size, border) for centre in centres]
    distances = []
    for _, dy, dx in offsets(kernel_size):
        distance = torch.zeros_like(start[:, :1], dtype=dtype)
        seen = [next(each) for each in moved]
        # The middle of the window is no distance away.
        if (dy, dx) != (0, 0):
            for scale, tap, centre in zip(scales, seen, centres, strict=True):
                distance = distance + scale * squared_distance(tap, centre)
            if spacing is not None:
                distance = distance + (dy * dy + dx * dx) * spacing
        distances.append(distance)
    return logits - torch.cat(distances, 1)
