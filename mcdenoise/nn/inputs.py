"""Network inputs: every buffer is scaled to a range from 0 to about 1, independent of the scene's units."""

from __future__ import annotations

import torch
from torch import Tensor

from mcdenoise.frame import Frame
from mcdenoise.ops._window import accumulator_dtype, block_means

# The least number that a depth counts as, and how many near depths away the scene ends.
_SHORTEST, _FARTHEST = 1e-30, 1e4


def auto_exposure(color: Tensor, key: float = 0.5) -> Tensor:
    """The factor that brings an image's typical radiance to ``key``, so that no network depends on a scene's unit.

    ``key / exp(mean(log(blocks)))`` over the means of 16x16-pixel blocks: noise hardly changes a block's mean, and a
    visible lamp hardly changes the mean logarithm.

    Args:
        color: ``(B, C, H, W)`` radiance up to 1e35; smaller values than 1e-30 count as 1e-30.
        key: radiance to which the typical block is scaled.

    Returns:
        ``(B, 1, 1, 1)`` positive, finite factor in the dtype of ``color``; 1 for a black image. It has no gradient.
    """
    # Convert half precision to float32; keep float64.
    luminance = color.detach().to(torch.promote_types(color.dtype, torch.float32)).mean(1, keepdim=True)
    blocks = block_means(luminance, 16)
    mean = blocks.mean((1, 2, 3), keepdim=True)
    lit = mean > 0
    # Relative to the mean, so that the logarithms are small at any exposure. Black blocks count as a thousandth of it.
    fractions = (blocks / torch.where(lit, mean, 1)).clamp_min(1e-3)
    typical = (mean * torch.exp(torch.log(fractions).mean((1, 2, 3), keepdim=True))).clamp_min(1e-30)
    return torch.where(lit, key / typical, 1).clamp_max(torch.finfo(color.dtype).max).to(color.dtype)


def normalize_depth(depth: Tensor) -> Tensor:
    """Map depth to [0, 1), whatever the scene's unit: ``d / (d + typical d)``, and 1 where nothing was hit.

    Args:
        depth: ``(B, 1, H, W)`` distance, scene units, ``inf`` where nothing was hit.

    Returns:
        ``(B, 1, H, W)`` in [0, 1]. The typical depth is the geometric mean over all pixels with a hit.
    """
    return normalized_depth(depth, *depth_scale(depth))


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
    known = torch.where((known >= _SHORTEST) & (known < torch.inf), known, torch.inf)
    root = known.rsqrt().sum((1, 2, 3), keepdim=True) / (known < torch.inf).sum((1, 2, 3), keepdim=True).clamp_min(1)
    near = torch.where(root > 0, 1 / torch.where(root > 0, root, 1).square(), 1)
    in_units = (depth / near).clamp_min(_SHORTEST)
    counts = in_units <= _FARTHEST
    total = torch.log(torch.where(counts, in_units, 1)).sum((1, 2, 3), keepdim=True)
    return near, torch.exp(total / counts.sum((1, 2, 3), keepdim=True).clamp_min(1))


def normalized_depth(depth: Tensor, near: Tensor, typical: Tensor) -> Tensor:
    """``d / (d + typical d)`` with :func:`depth_scale`, and 1 where nothing was hit."""
    hit = torch.isfinite(depth)
    in_units = (torch.where(hit, depth, 1).to(near.dtype) / near).clamp(_SHORTEST, 1 / _SHORTEST)
    return torch.where(hit, in_units / (in_units + typical), 1).to(depth.dtype)


def features_of(frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
    """Albedo, normal and depth of a frame; a missing one is a constant image, which guides nothing."""
    color = frame.color
    albedo = torch.ones_like(color) if frame.albedo is None else frame.albedo
    normal = torch.zeros_like(color) if frame.normal is None else frame.normal
    return albedo, normal, torch.ones_like(color[:, :1]) if frame.depth is None else frame.depth


def image_statistics(frame: Frame) -> dict[str, Tensor]:
    """Exposure and depth scale of a whole image, unless the frame has them already.

    Returns:
        ``exposure`` ``(B, 1, 1, 1)``, see :func:`auto_exposure`; ``depth_scale`` ``(B, 2, 1, 1)``, see
        :func:`depth_scale`, for a depth of 1 if there is none. A second network uses the values of the first one.
    """
    found = {name: frame.statistics[name] for name in ("exposure", "depth_scale") if name in frame.statistics}
    if "exposure" not in found:
        found["exposure"] = auto_exposure(frame.color)
    if "depth_scale" not in found:
        depth = frame.color.new_ones(frame.color.shape[0], 1, 1, 1) if frame.depth is None else frame.depth
        found["depth_scale"] = torch.cat(depth_scale(depth), 1)
    return found


def unit_features_of(frame: Frame) -> list[Tensor]:
    """Albedo, normal and depth in [0, 1], with the scale of :func:`image_statistics`."""
    albedo, normal, depth = features_of(frame)
    return [albedo, normal * 0.5 + 0.5, normalized_depth(depth, *image_statistics(frame)["depth_scale"].split(1, 1))]
