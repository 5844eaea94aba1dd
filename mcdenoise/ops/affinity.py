"""Filter an image by the affinity of neural features: how similar they are at two pixels."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from mcdenoise.ops._autograd import Function
from mcdenoise.ops._check import check_shapes
from mcdenoise.ops._constants import FARTHEST_FEATURE, LEAST_CENTER
from mcdenoise.ops._module import module_of
from mcdenoise.ops._op import op
from mcdenoise.ops._window import accumulator_dtype, offsets, pad, shifted


def _check_settings(kernel_size: int, dilation: int) -> None:
    if kernel_size < 1 or kernel_size % 2 == 0:
        raise ValueError(f"kernel_size: expected odd and at least 1, found {kernel_size}")
    if dilation < 1:
        raise ValueError(f"dilation: expected at least 1, found {dilation}")


def _check(
    image: Tensor,
    features: Tensor,
    bandwidth: Tensor,
    center: Tensor,
    previous: Tensor | None = None,
    previous_features: Tensor | None = None,
    previous_bandwidth: Tensor | None = None,
    previous_weight: Tensor | None = None,
    *,
    kernel_size: int = 7,
    dilation: int = 1,
) -> None:
    _check_settings(kernel_size, dilation)
    arguments = {
        "image": (image, "B C H W"),
        "features": (features, "B F H W"),
        "bandwidth": (bandwidth, "B 1 H W"),
        "center": (center, "B 1 H W"),
    }
    layouts = {
        "previous": (previous, "B C H W"),
        "previous_features": (previous_features, "B F H W"),
        "previous_bandwidth": (previous_bandwidth, "B 1 H W"),
        "previous_weight": (previous_weight, "B 1 H W"),
    }
    given = {name: (each, layout) for name, (each, layout) in layouts.items() if each is not None}
    check_shapes(**arguments, **given)
    if given and len(given) < len(layouts):
        absent = next(name for name in layouts if name not in given)
        raise ValueError(f"{absent}: expected with {next(iter(given))}, found None")


@op("numba", check=_check, differentiable=True)
def affinity_filter(
    image: Tensor,
    features: Tensor,
    bandwidth: Tensor,
    center: Tensor,
    previous: Tensor | None = None,
    previous_features: Tensor | None = None,
    previous_bandwidth: Tensor | None = None,
    previous_weight: Tensor | None = None,
    *,
    kernel_size: int = 7,
    dilation: int = 1,
) -> Tensor:
    """Filter an image by pairwise affinities of features, and with it the image of the frame before.

    ``out[p] = (sum_q w[p, q] image[q] + sum_q v[p, q] previous[q]) / (sum_q w[p, q] + sum_q v[p, q])`` over the taps
    ``q`` of a window of ``kernel_size`` by ``kernel_size`` taps, ``dilation`` pixels apart, that are inside the image:

    - ``w[p, p] = max(center[p], 1e-6)``, else ``w[p, q] = exp(-bandwidth[p] |features[p] - features[q]|^2)``,
    - ``v[p, q] = previous_weight[q] exp(-previous_bandwidth[p] |features[p] - previous_features[q]|^2)``, also for
      ``q = p``; without ``previous`` it is 0.

    Where ``center`` is 0 and no tap is like the pixel, all weights but its own 1e-6 vanish, and it keeps its value.

    Args:
        image: ``(B, C, H, W)`` radiance, or anything up to 1e36 of either sign.
        features: ``(B, F, H, W)``, any unit; each difference counts as at most 1e15.
        bandwidth: ``(B, 1, H, W)`` of each pixel, 0 to 1e6, in one over the unit of the features squared.
        center: ``(B, 1, H, W)`` weight of the pixel itself, in [0, 1]; a tap with the same features has the weight 1.
        previous: ``(B, C, H, W)`` reprojected image of the frame before; requires the next three arguments.
        previous_features: ``(B, F, H, W)`` likewise.
        previous_bandwidth: ``(B, 1, H, W)``, as ``bandwidth``.
        previous_weight: ``(B, 1, H, W)`` in [0, 1], how much of ``previous`` is known at each of its pixels.
        kernel_size: taps along each axis, odd and at least 1.
        dilation: pixels between taps, at least 1.

    Returns:
        ``(B, C, H, W)`` in the dtype of ``image``, means of its pixels and of those of ``previous``. Half precision is
        computed in float32.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: shapes disagree, a setting does not fit, or an argument about the frame before is missing.

    Differentiable in all tensors, to any order, where ``center`` is above 1e-6. The derivative keeps the arguments, but
    no weights of taps, and costs about three times the filter.

    Source: Isik et al. 2021, "Interactive Monte Carlo Denoising using Affinity of Neural Features": the equations of
    its pairwise affinity, of the dilated filters, and of the temporal one. ``previous_weight`` and the smallest weight
    of the centre are added here.

    Example:
        >>> image = torch.tensor([0.0, 1.0, 5.0, 6.0]).reshape(1, 1, 1, 4)
        >>> features = torch.tensor([0.0, 0.0, 9.0, 9.0]).reshape(1, 1, 1, 4)
        >>> one = torch.ones(1, 1, 1, 4)
        >>> affinity_filter(image, features, one, one).flatten().tolist()
        [0.5, 0.5, 5.5, 5.5]
    """
    if image.numel() == 0:
        return image
    dtype = accumulator_dtype(image.dtype)
    values, here, own = (each.to(dtype) for each in (image, features, center))
    # The last channel sums the weights: outside the image it is 0, like all others.
    values = torch.cat([values, torch.ones_like(own)], 1)
    sums = own.clamp_min(LEAST_CENTER) * values
    sums = sums + _affine(here, here, values, bandwidth, kernel_size, dilation, skip_center=True)
    there, width, known = previous_features, previous_bandwidth, previous_weight
    if previous is not None and there is not None and width is not None and known is not None:
        weighed = torch.cat([previous.to(dtype) * known.to(dtype), known.to(dtype)], 1)
        sums = sums + _affine(here, there.to(dtype), weighed, width, kernel_size, dilation, skip_center=False)
    return (sums[:, :-1] / sums[:, -1:]).to(image.dtype)


AffinityFilter = module_of("AffinityFilter", affinity_filter, _check_settings)


def _affine(
    here: Tensor,
    there: Tensor,
    values: Tensor,
    bandwidth: Tensor,
    kernel_size: int,
    dilation: int,
    *,
    skip_center: bool,
) -> Tensor:
    radius = kernel_size // 2 * dilation
    padded = pad(there, radius, "zeros"), pad(values, radius, "zeros")
    return _Affine.of(here, *padded, bandwidth.to(here.dtype), kernel_size, dilation, skip_center)


class _Affine(Function):
    """``sum_q exp(-a[p] |f[p] - g[q]|^2) v[q]``, in passes over the taps, with no stack of them.

    Its derivatives compute the weights once more; they are plain torch, recorded only when a second derivative is asked
    for.
    """

    @staticmethod
    def forward(
        here: Tensor, there: Tensor, values: Tensor, bandwidth: Tensor, kernel_size: int, dilation: int, skip: bool
    ) -> Tensor:
        total = values.new_zeros(*values.shape[:2], *here.shape[-2:])
        for dy, dx in taps_of(kernel_size, dilation, skip):
            _, _, weight = affinity_of(here, there, bandwidth, dy, dx)
            total.addcmul_(weight, tap_of(values, here, dy, dx))
        return total

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Tensor) -> None:
        *tensors, ctx.kernel_size, ctx.dilation, ctx.skip = inputs
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)

    @staticmethod
    def tangent(
        ctx: Any,
        of_here: Tensor | None,
        of_there: Tensor | None,
        of_values: Tensor | None,
        of_bandwidth: Tensor | None,
        *_: None,
    ) -> Tensor:
        here, there, values, bandwidth = ctx.saved_tensors
        total: Tensor = values.new_zeros(*values.shape[:2], *here.shape[-2:])
        for dy, dx in taps_of(ctx.kernel_size, ctx.dilation, ctx.skip):
            difference, distance, weight = affinity_of(here, there, bandwidth, dy, dx)
            of_exponent = torch.zeros_like(weight)
            if of_bandwidth is not None:
                of_exponent = of_exponent - distance * of_bandwidth
            if of_here is not None:
                of_exponent = of_exponent - 2 * bandwidth * (difference * of_here).sum(1, keepdim=True)
            if of_there is not None:
                moved = tap_of(of_there, here, dy, dx)
                of_exponent = of_exponent + 2 * bandwidth * (difference * moved).sum(1, keepdim=True)
            total = total + weight * of_exponent * tap_of(values, here, dy, dx)
            if of_values is not None:
                total = total + weight * tap_of(of_values, here, dy, dx)
        return total

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        saved = ctx.saved_tensors
        here, there, values, bandwidth = saved
        # Under vmap each result must have the axis of whichever of these has one.
        none = gradient.new_zeros(())
        for each in saved:
            none = none + each.new_zeros(())
        to_here, to_there, to_values, to_bandwidth = (torch.zeros_like(each) + none for each in saved)
        for dy, dx in taps_of(ctx.kernel_size, ctx.dilation, ctx.skip):
            difference, distance, weight = affinity_of(here, there, bandwidth, dy, dx)
            of_exponent = weight * (gradient * tap_of(values, here, dy, dx)).sum(1, keepdim=True)
            pull = (2 * of_exponent * bandwidth) * difference
            to_bandwidth = to_bandwidth - of_exponent * distance
            to_here = to_here - pull
            tap_of(to_there, here, dy, dx).add_(pull)
            tap_of(to_values, here, dy, dx).add_(weight * gradient)
        return to_here, to_there, to_values, to_bandwidth, None, None, None


def taps_of(kernel_size: int, dilation: int, skip_center: bool) -> list[tuple[int, int]]:
    """Row and column offset of each tap in pixels."""
    every = [(dy * dilation, dx * dilation) for _, dy, dx in offsets(kernel_size)]
    return [at for at in every if at != (0, 0)] if skip_center else every


def tap_of(padded: Tensor, image: Tensor, dy: int, dx: int) -> Tensor:
    """The view of ``padded`` in which each pixel of ``image`` shows the tap at that offset."""
    height, width = image.shape[-2:]
    return shifted(padded, (padded.shape[-2] - height) // 2, dy, dx, height, width)


def affinity_of(here: Tensor, there: Tensor, bandwidth: Tensor, dy: int, dx: int) -> tuple[Tensor, Tensor, Tensor]:
    """The difference of the features here and at a tap, its square, and the weight."""
    difference = (here - tap_of(there, here, dy, dx)).clamp(-FARTHEST_FEATURE, FARTHEST_FEATURE)
    distance = difference.square().sum(1, keepdim=True)
    return difference, distance, torch.exp(-bandwidth * distance)
