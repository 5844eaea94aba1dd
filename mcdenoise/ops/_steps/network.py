"""The steps between the convolutions of networks."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.ops._constants import BLOCK, DARK, FARTHEST, SHORTEST
from mcdenoise.ops._numbers import numbers_like
from mcdenoise.ops._op import op, plain
from mcdenoise.ops._rows import by_rows
from mcdenoise.ops._window import accumulator_dtype, corner
from mcdenoise.ops.fusion import downsample, laplacian_fusion, upsample

__all__ = [
    "BLOCK",
    "buffers_input",
    "depth_scale",
    "gated_fusion",
    "low_frequencies_of",
    "network_features",
    "network_guides",
    "network_input",
    "normalized_depth",
    "softplus",
]


@op("numba")
def network_input(image: Tensor, features: Tensor, *, logarithms: bool = True) -> Tensor:
    """``torch.cat([torch.log1p(image), features], 1)`` as a convolution takes it: channels-last, precision of autocast.

    Args:
        image: ``(B, C, H, W)`` radiance; or logarithms of radiance already.
        features: ``(B, F, H, W)`` of the same dtype.
        logarithms: whether to take them.

    Returns:
        ``(B, C + F, H, W)``. The reference implementation leaves layout and precision to the convolution.
    """
    return torch.cat([torch.log1p(image) if logarithms else image, features], 1)


@op("numba")
def buffers_input(
    image: Tensor,
    albedo: Tensor,
    normal: Tensor,
    depth: Tensor,
    current: Tensor,
    length: Tensor | None,
    exposure: Tensor,
    scale: tuple[Tensor, Tensor],
    *,
    logarithms: bool = True,
    image_factor: Tensor | None = None,
) -> Tensor:
    """An image and its buffers as a convolution takes them: channels-last, precision of autocast.

    ``network_input(image * image_factor, network_features(albedo, normal, ...))``, without the features on the way.

    Args:
        image: ``(B, 3, H, W)`` radiance; or logarithms of radiance already.
        albedo: see :func:`network_features`.
        normal: see :func:`network_features`.
        depth: see :func:`network_features`.
        current: see :func:`network_features`.
        length: see :func:`network_features`.
        exposure: see :func:`network_features`.
        scale: see :func:`network_features`.
        logarithms: whether to take those of the image.
        image_factor: ``(B, 1, 1, 1)`` factor of the image, before any logarithm; 1 by default.

    Returns:
        ``(B, 14, H, W)``: the image, then the features. The reference leaves layout and precision to the convolution.
    """
    features = plain(network_features)(albedo, normal, depth, current, length, exposure, scale)
    image = image if image_factor is None else image * image_factor
    return plain(network_input)(image, features, logarithms=logarithms)


@op("numba")
def network_guides(normal: Tensor, depth: Tensor, scale: tuple[Tensor, Tensor]) -> Tensor:
    """Normal and depth as :func:`network_features` has them, to guide a filter.

    Args:
        normal: ``(B, 3, H, W)`` in [-1, 1].
        depth: ``(B, 1, H, W)`` distance, ``inf`` where nothing was hit.
        scale: of :func:`depth_scale`.

    Returns:
        ``(B, 4, H, W)``: ``normal / 2 + 1 / 2``, and :func:`normalized_depth`.
    """
    return torch.cat([normal * 0.5 + 0.5, normalized_depth(depth, *scale)], 1)


@op("numba")
def depth_scale(depth: Tensor) -> tuple[Tensor, Tensor]:
    """A near depth as the unit of depths, and the typical depth in that unit: the geometric mean of all hits.

    The near depth is ``1 / mean(1 / sqrt(d))^2``, which far depths hardly change. Depths 10,000 times as large are no
    part of the scene, but a sky to which the renderer gave a large finite depth (Blender 1e10, others 1e30), and do not
    count: their logarithm would hide all differences of near depths.

    Args:
        depth: ``(B, 1, H, W)`` distance, any unit, ``inf`` where nothing was hit.

    Returns:
        ``(B, 1, 1, 1)`` each, at least float32; 1 where there is nothing to count. Depths below 1e-30, such as zeros,
        tell nothing of the near depth, and none counts as less than 1e-30 of it. The near depth is a mere unit and has
        no derivative.
    """
    dtype = accumulator_dtype(depth.dtype)

    def totals(values: Tensor, count: Tensor) -> Tensor:
        """Sums of the values of each row, and how many they are."""
        return torch.cat([values.sum(-1, keepdim=True), count.sum(-1, keepdim=True).to(values.dtype)], 1)

    def mean(rows: Tensor) -> Tensor:
        total, count = rows.sum((2, 3), keepdim=True).unbind(1)
        return (total / count.clamp_min(1))[:, None]

    def roots(rows: Tensor) -> Tensor:
        rows = rows.detach().to(dtype)
        counts = torch.isfinite(rows) & (rows >= SHORTEST)
        return totals(torch.where(counts, torch.where(counts, rows, 1).rsqrt(), 0), counts)

    def logarithms(rows: Tensor) -> Tensor:
        in_units = _in_units(rows, near)
        counts = torch.isfinite(rows) & (in_units <= FARTHEST)
        return totals(torch.where(counts, torch.log(in_units), 0), counts)

    root = mean(by_rows(roots, depth))
    near = torch.where(root > 0, 1 / torch.where(root > 0, root, 1).square(), 1)
    return near, torch.exp(mean(by_rows(logarithms, depth)))


def _in_units(depth: Tensor, near: Tensor) -> Tensor:
    """From 1e-30 to 1e30; 1 where nothing was hit."""
    hit = torch.isfinite(depth)
    return torch.where(hit, (torch.where(hit, depth, 1).to(near.dtype) / near).clamp(SHORTEST, 1 / SHORTEST), 1)


def normalized_depth(depth: Tensor, near: Tensor, typical: Tensor) -> Tensor:
    """``d / (d + typical d)`` with :func:`depth_scale`, and 1 where nothing was hit."""
    in_units = _in_units(depth, near)
    return torch.where(torch.isfinite(depth), in_units / (in_units + typical), 1).to(depth.dtype)


@op("numba")
def network_features(
    albedo: Tensor,
    normal: Tensor,
    depth: Tensor,
    current: Tensor,
    length: Tensor | None,
    exposure: Tensor,
    scale: tuple[Tensor, Tensor],
) -> Tensor:
    """Buffers as a network sees them, each in a range from 0 to about 1.

    Args:
        albedo: ``(B, 3, H, W)`` in [0, 1].
        normal: ``(B, 3, H, W)`` in [-1, 1].
        depth: ``(B, 1, H, W)`` distance, ``inf`` where nothing was hit.
        current: ``(B, 3, H, W)`` radiance.
        length: ``(B, 1, H, W)`` at least 1; 1 by default.
        exposure: ``(B, 1, 1, 1)`` factor of the radiance.
        scale: of :func:`depth_scale`.

    Returns:
        ``(B, 11, H, W)``: albedo, normal, depth, logarithm of the radiance, and one over the length.
    """
    fraction = torch.ones_like(depth) if length is None else 1 / length
    near = normalized_depth(depth, *scale)
    return torch.cat([albedo, normal * 0.5 + 0.5, near, torch.log1p(current * exposure), fraction], 1)


@op("numba")
def gated_fusion(
    fine: Tensor,
    coarse: Tensor,
    weight: Tensor,
    bias: Tensor,
    *,
    residual: Tensor | None = None,
    maximum: Tensor | None = None,
    logarithms: bool = False,
) -> Tensor:
    """Fuse two scales with an ``alpha`` that a convolution of both predicts.

    ``laplacian_fusion(i, coarse, sigmoid(conv3x3([i, upsample(coarse)])))`` with ``i = fine + residual``. With
    ``logarithms``, ``i = log1p(fine)``, and the low frequencies that are exchanged are logarithms of means,
    ``i + alpha (U(coarse) - U(log1p(D(fine))))``: means of radiance on both sides, so that a coarse scale that agrees
    with the fine one changes nothing, as in the paper's Eq. 2.

    Args:
        fine: ``(B, C, H, W)``, any unit; logarithms of radiance if there is a ``maximum``.
        coarse: ``(B, C, ceil(H / 2), ceil(W / 2))`` of the same unit and dtype.
        weight: ``(1, 2 C, 3, 3)``.
        bias: ``(1,)``.
        residual: ``(B, C, H, W)`` to be added to ``fine``, any dtype; none by default, nor with ``logarithms``.
        maximum: ``(B, 1, 1, 1)`` largest logarithm of the radiance of the result, which is then handed out as radiance:
            ``expm1`` of the logarithm clamped to the range from 0 to ``maximum``.
        logarithms: whether to take those of ``fine``, which then is radiance: ``log1p``.

    Returns:
        ``(B, C, H, W)``, at least float32. The fast backend computes ``alpha`` in the dtype of the result, also under
        autocast.

    Raises:
        ValueError: there are both a residual and ``logarithms``.
    """
    if logarithms and residual is not None:
        raise ValueError("residual: expected None where logarithms are taken, found a tensor")
    size = (fine.shape[-2], fine.shape[-1])
    detail = torch.log1p(fine) if logarithms else fine
    if residual is not None:
        detail = residual.to(accumulator_dtype(residual.dtype)) + detail
    both = torch.cat([detail, upsample(coarse, size)], 1)
    alpha = torch.sigmoid(F.conv2d(both, weight, bias, padding=1)).to(detail.dtype)
    if logarithms:
        fused = detail + alpha * upsample(coarse - torch.log1p(downsample(fine)), size)
    else:
        fused = laplacian_fusion(detail, coarse, alpha)
    return fused if maximum is None else torch.expm1(torch.minimum(fused.clamp_min(0), maximum))


@op("numba")
def low_frequencies_of(fine: Tensor, coarse: Tensor, maximum: Tensor, exposure: Tensor | None = None) -> Tensor:
    """An image with the means of another in the place of its own, over blocks of 8x8 pixels.

    ``fine * (U m(coarse) + e) / (U m(fine) + e)`` with the means ``m`` of blocks, interpolated bilinearly by ``U``.
    Since it multiplies, and both means are interpolated alike, no light of a lamp gets on the dark wall beside it.

    Args:
        fine: ``(B, C, H, W)`` radiance, up to 1e35 in units of a typical one.
        coarse: ``(B, C, ceil(H / 2), ceil(W / 2))`` of the same unit and dtype.
        maximum: ``(B, 1, 1, 1)`` largest logarithm of the exposed radiance of the result.
        exposure: ``(B, 1, 1, 1)`` factor that brings the radiance to units of a typical one; 1 by default.

    Returns:
        ``(B, C, H, W)`` radiance, at most ``expm1(maximum) / exposure``.
    """
    means, most = downsample(fine), torch.expm1(maximum)
    for _ in range(BLOCK.bit_length() - 2):
        means, coarse = downsample(means), downsample(coarse)
    if exposure is not None:
        means, coarse, most = means * exposure, coarse * exposure, most / exposure
    wide = F.interpolate(torch.cat([coarse, means], 1), scale_factor=BLOCK, mode="bilinear") + DARK
    wanted, found = corner(wide, fine.shape[-2], fine.shape[-1]).chunk(2, 1)
    return torch.minimum(fine * (wanted / found), most)


@op("numba")
def softplus(x: Tensor, units: Sequence[float]) -> Tensor:
    """``F.softplus(x)`` in units of its own for each channel, as contiguous planes of at least float32.

    Args:
        x: ``(B, C, H, W)`` of any layout, such as some channels of a network's prediction.
        units: factor of each channel of the result.
    """
    planes = F.softplus(x.to(accumulator_dtype(x.dtype)).contiguous())
    return planes * numbers_like(planes, units).reshape(-1, 1, 1)
