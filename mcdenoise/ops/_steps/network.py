"""The steps between the convolutions of networks."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.ops._constants import SHORTEST
from mcdenoise.ops._numbers import numbers_like
from mcdenoise.ops._op import op
from mcdenoise.ops._window import accumulator_dtype, corner
from mcdenoise.ops.fusion import downsample, laplacian_fusion, upsample

__all__ = [
    "BLOCK",
    "buffers_input",
    "depth_scale",
    "gated_fusion",
    "low_frequencies_of",
    "normalized_depth",
    "softplus",
]

# Side of the blocks whose means are an image's low frequencies, in pixels. Below this fraction of a typical radiance
# they are left alone.
BLOCK, DARK = 8, 1e-3
# How many near depths away the scene ends.
FARTHEST = 1e4


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
) -> Tensor:
    """An image and its buffers, each in a range from 0 to about 1.

    Args:
        image: ``(B, 3, H, W)`` radiance; or logarithms of radiance already.
        albedo: ``(B, 3, H, W)`` in [0, 1].
        normal: ``(B, 3, H, W)`` in [-1, 1].
        depth: ``(B, 1, H, W)`` distance, ``inf`` where nothing was hit.
        current: ``(B, 3, H, W)`` radiance.
        length: ``(B, 1, H, W)`` at least 1; 1 by default.
        exposure: ``(B, 1, 1, 1)`` factor of the current radiance.
        scale: of :func:`depth_scale`.
        logarithms: whether to take those of the image.

    Returns:
        ``(B, 14, H, W)``: the logarithm of the image; albedo, normal, depth, logarithm of the current radiance, and one
        over the length. The fast backend writes it as a convolution takes it: channels-last, in the precision of
        autocast.
    """
    image = torch.log1p(image) if logarithms else image
    fraction = torch.ones_like(depth) if length is None else 1 / length
    guides = normal * 0.5 + 0.5, normalized_depth(depth, *scale)
    return torch.cat([image, albedo, *guides, torch.log1p(current * exposure), fraction], 1)


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
    depth = depth.to(accumulator_dtype(depth.dtype))
    known = depth.detach()
    known = torch.where((known >= SHORTEST) & (known < torch.inf), known, torch.inf)
    root = known.rsqrt().sum((1, 2, 3), keepdim=True) / (known < torch.inf).sum((1, 2, 3), keepdim=True).clamp_min(1)
    near = torch.where(root > 0, 1 / torch.where(root > 0, root, 1).square(), 1)
    in_units = (depth / near).clamp_min(SHORTEST)
    counts = in_units <= FARTHEST
    total = torch.log(torch.where(counts, in_units, 1)).sum((1, 2, 3), keepdim=True)
    return near, torch.exp(total / counts.sum((1, 2, 3), keepdim=True).clamp_min(1))


def _in_units(depth: Tensor, near: Tensor) -> Tensor:
    """From 1e-30 to 1e30; 1 where nothing was hit."""
    hit = torch.isfinite(depth)
    return torch.where(hit, (torch.where(hit, depth, 1).to(near.dtype) / near).clamp(SHORTEST, 1 / SHORTEST), 1)


def normalized_depth(depth: Tensor, near: Tensor, typical: Tensor) -> Tensor:
    """``d / (d + typical d)`` with :func:`depth_scale`, and 1 where nothing was hit."""
    in_units = _in_units(depth, near)
    return torch.where(torch.isfinite(depth), in_units / (in_units + typical), 1).to(depth.dtype)


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


def softplus(x: Tensor, units: Sequence[float]) -> Tensor:
    """``F.softplus(x)`` in units of its own for each channel, as contiguous planes of at least float32.

    Args:
        x: ``(B, C, H, W)`` of any layout, such as some channels of a network's prediction.
        units: factor of each channel of the result.
    """
    planes = F.softplus(x.to(accumulator_dtype(x.dtype)).contiguous())
    return planes * numbers_like(planes, units).reshape(-1, 1, 1)
