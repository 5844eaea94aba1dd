"""Filter an image by the affinity of neural features: how similar they are at two pixels."""

from __future__ import annotations

import torch
from torch import Tensor

from mcdenoise.ops._check import check_kernel_size, check_least
from mcdenoise.ops._constants import FARTHEST_FEATURE, LEAST_CENTER
from mcdenoise.ops._distance import squared_distance
from mcdenoise.ops._module import module_of
from mcdenoise.ops._op import op
from mcdenoise.ops._window import accumulator_dtype, offsets, pad, shifted


def _check_settings(kernel_size: int, dilation: int) -> None:
    check_kernel_size(kernel_size)
    check_least(1, dilation=dilation)


def _check(
    previous: Tensor | None,
    previous_features: Tensor | None,
    previous_bandwidth: Tensor | None,
    previous_weight: Tensor | None,
    kernel_size: int,
    dilation: int,
) -> None:
    _check_settings(kernel_size, dilation)
    images = {
        "previous": previous,
        "previous_features": previous_features,
        "previous_bandwidth": previous_bandwidth,
        "previous_weight": previous_weight,
    }
    absent = [name for name, image in images.items() if image is None]
    if 0 < len(absent) < len(images):
        there = next(name for name in images if name not in absent)
        raise ValueError(f"{absent[0]}: expected with {there}, found None")


@op(
    "numba",
    check=_check,
    image="B C H W",
    features="B F H W",
    bandwidth="B 1 H W",
    center="B 1 H W",
    previous="[B C H W]",
    previous_features="[B F H W]",
    previous_bandwidth="[B 1 H W]",
    previous_weight="[B 1 H W]",
)
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

    Differentiable in all tensors, to any order, where ``center`` is above 1e-6. The derivative keeps two numbers for
    each tap of each pixel.

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
    values, here, own, near = (each.to(dtype) for each in (image, features, center, bandwidth))
    # The last channel sums the weights: outside the image it is 0, like all others.
    values = torch.cat([values, torch.ones_like(own)], 1)
    sums = own.clamp_min(LEAST_CENTER) * values
    sums = sums + _affine(here, here, values, near, kernel_size, dilation, skip_center=True)
    there, width, known = previous_features, previous_bandwidth, previous_weight
    if previous is not None and there is not None and width is not None and known is not None:
        weighed = torch.cat([previous.to(dtype) * known.to(dtype), known.to(dtype)], 1)
        sums = sums + _affine(here, there.to(dtype), weighed, width.to(dtype), kernel_size, dilation, skip_center=False)
    return (sums[:, :-1] / sums[:, -1:]).to(image.dtype)


AffinityFilter = module_of(affinity_filter, _check_settings)


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
    """``sum_q exp(-a[p] |f[p] - g[q]|^2) v[q]``."""
    radius = kernel_size // 2 * dilation
    padded = [pad(each, radius, "zeros") for each in (there, values)]
    total = torch.zeros_like(values)
    for _, dy, dx in offsets(kernel_size):
        if skip_center and dy == dx == 0:
            continue
        tap, value = (shifted(each, radius, dy * dilation, dx * dilation, *here.shape[-2:]) for each in padded)
        total = total + torch.exp(-bandwidth * squared_distance(here, tap, FARTHEST_FEATURE)) * value
    return total
