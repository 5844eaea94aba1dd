"""Network inputs: every buffer is scaled to a range from 0 to about 1, independent of the scene's units."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.frame import Frame
from mcdenoise.ops._steps.network import buffers_input, depth_scale, normalized_depth

FEATURES = 11  # albedo 3, normal 3, depth 1, color of the current frame 3, one over the history length 1


def auto_exposure(color: Tensor, key: float = 0.5) -> Tensor:
    """The factor that brings an image's typical radiance to ``key``, so that no network depends on a scene's unit.

    ``key / exp(mean(log(blocks)))`` over the means of 16x16-pixel blocks: noise hardly changes a block's mean, and a
    visible lamp hardly changes the mean logarithm.

    Args:
        color: ``(B, C, H, W)`` radiance up to 1e35; smaller values than 1e-30 count as 1e-30.
        key: radiance to which the typical block is scaled.

    Returns:
        ``(B, 1, 1, 1)`` positive factor; 1 for a black image. The factor has no gradient.
    """
    # Convert half precision to float32; keep float64.
    luminance = color.detach().to(torch.promote_types(color.dtype, torch.float32)).mean(1, keepdim=True)
    blocks = F.avg_pool2d(luminance, 16, ceil_mode=True, count_include_pad=False)
    mean = blocks.mean((1, 2, 3), keepdim=True)
    lit = mean > 0
    # Relative to the mean, so that the logarithms are small at any exposure. Black blocks count as a thousandth of it.
    fractions = (blocks / torch.where(lit, mean, 1)).clamp_min(1e-3)
    typical = (mean * torch.exp(torch.log(fractions).mean((1, 2, 3), keepdim=True))).clamp_min(1e-30)
    return torch.where(lit, key / typical, 1).to(color.dtype)


def normalize_depth(depth: Tensor) -> Tensor:
    """Map depth to [0, 1), whatever the scene's unit: ``d / (d + typical d)``, and 1 where nothing was hit.

    Args:
        depth: ``(B, 1, H, W)`` distance, scene units, ``inf`` where nothing was hit.

    Returns:
        ``(B, 1, H, W)`` in [0, 1]. The typical depth is the geometric mean over all pixels with a hit.
    """
    return normalized_depth(depth, *depth_scale(depth))


def features_of(frame: Frame) -> tuple[Tensor, Tensor, Tensor]:
    """Albedo, normal and depth of a frame; a missing one is a constant image, which guides nothing."""
    color = frame.color
    albedo = torch.ones_like(color) if frame.albedo is None else frame.albedo
    normal = torch.zeros_like(color) if frame.normal is None else frame.normal
    return albedo, normal, torch.ones_like(color[:, :1]) if frame.depth is None else frame.depth


def scale_of_depth(frame: Frame) -> dict[str, Tensor]:
    """``depth_scale`` of a whole image ``(B, 2, 1, 1)``, see :func:`mcdenoise.ops._steps.network.depth_scale`.

    Returns:
        An empty dictionary if the frame has the value already, or has no depth.
    """
    if frame.depth is None or "depth_scale" in frame.statistics:
        return {}
    return {"depth_scale": torch.cat(depth_scale(frame.depth), 1)}


def image_statistics(frame: Frame) -> dict[str, Tensor]:
    """Exposure and depth scale of a whole image, unless the frame has them already.

    Returns:
        ``exposure`` ``(B, 1, 1, 1)``, see :func:`auto_exposure`; ``depth_scale``, see :func:`scale_of_depth`, for a
        depth of 1 if there is none. A second network uses the values of the first one.
    """
    found = {name: frame.statistics[name] for name in ("exposure", "depth_scale") if name in frame.statistics}
    if "exposure" not in found:
        found["exposure"] = auto_exposure(frame.color)
    found |= scale_of_depth(frame)
    if "depth_scale" not in found:
        found["depth_scale"] = torch.cat(depth_scale(frame.color.new_ones(frame.color.shape[0], 1, 1, 1)), 1)
    return found


def input_of(frame: Frame, image: Tensor, *, logarithms: bool = True) -> Tensor:
    """A network's input: the logarithm of an image, and the features of a frame.

    Args:
        frame: with the statistics of :func:`image_statistics`.
        image: ``(B, 3, H, W)`` exposed radiance, or its logarithm.
        logarithms: whether ``image`` is radiance, whose logarithm is to be taken.

    Returns:
        ``(B, 14, H, W)``: ``log1p(image)``; albedo, normal and depth in [0, 1]; ``log1p`` of the exposed radiance of
        the current frame; and one over the history length.
    """
    current = frame.color if frame.current is None else frame.current
    exposure, (near, typical) = frame.statistics["exposure"], frame.statistics["depth_scale"].split(1, 1)
    features = (*features_of(frame), current, frame.length, exposure, (near, typical))
    return buffers_input(image, *features, logarithms=logarithms)


def guides_of(frame: Frame) -> list[Tensor]:
    """Normal and depth in [0, 1], the guides of bilateral weights."""
    _, normal, depth = features_of(frame)
    near, typical = frame.statistics["depth_scale"].split(1, 1)
    return [normal * 0.5 + 0.5, normalized_depth(depth, near, typical)]


def unit_features_of(frame: Frame) -> list[Tensor]:
    """Albedo, normal and depth in [0, 1] for a frame with the statistics of :func:`image_statistics`."""
    return [features_of(frame)[0], *guides_of(frame)]
