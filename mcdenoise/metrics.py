"""How far an image is from its reference: one value for each image, with the domain in the name.

Images are ``(..., 3, H, W)`` scene-linear radiance; whatever stands before the last three axes is a batch.
"""

from __future__ import annotations

import torch
from kornia.color import linear_rgb_to_rgb
from torch import Tensor


def smape_linear(image: Tensor, reference: Tensor, *, epsilon: float = 1e-2) -> Tensor:
    """Symmetric mean absolute percentage error of scene-linear radiance: ``mean(|x - y| / (|x| + |y| + epsilon))``.

    Args:
        image: ``(..., C, H, W)`` scene-linear radiance.
        reference: of the same shape.
        epsilon: in the unit of the radiance.

    Returns:
        ``(...)`` in [0, 1], lower is better.

    Raises:
        ValueError: the shapes differ.

    Source: the paper's Eq. 9.

    Example:
        >>> smape_linear(torch.ones(1, 3, 2, 2), torch.full((1, 3, 2, 2), 3.0), epsilon=0.0).tolist()
        [0.5]
    """
    _check(image, reference)
    return ((image - reference).abs() / (image.abs() + reference.abs() + epsilon)).mean((-3, -2, -1))


def temporal_smape_linear(clip: Tensor, reference: Tensor, *, epsilon: float = 1e-2) -> Tensor:
    """SMAPE of the absolute differences between successive frames, which sees flicker and lag.

    With ``dx = |x_i - x_(i-1)|``, not motion-compensated: ``mean(|dx - dy| / (dx + dy + epsilon))``.

    Args:
        clip: ``(..., T, C, H, W)`` scene-linear radiance of successive frames, T at least 2.
        reference: of the same shape.
        epsilon: in the unit of the radiance.

    Returns:
        ``(...)`` in [0, 1], lower is better.

    Raises:
        ValueError: the shapes differ, or there are fewer than two frames.

    Source: the paper's Eq. 10.

    Example:
        >>> clip = torch.rand(4, 3, 2, 2)
        >>> temporal_smape_linear(clip + 1, clip).item() < 1e-4  # a constant error does not flicker
        True
    """
    _check(clip, reference)
    if clip.ndim < 4 or clip.shape[-4] < 2:
        raise ValueError(f"clip: expected (..., T, C, H, W) with at least 2 frames, found {tuple(clip.shape)}")
    return smape_linear(clip.diff(dim=-4).abs(), reference.diff(dim=-4).abs(), epsilon=epsilon).mean(-1)


def relmse_linear(image: Tensor, reference: Tensor, *, epsilon: float = 1e-2) -> Tensor:
    """Relative mean squared error of scene-linear radiance: ``mean((x - y)^2 / (mean_rgb(y)^2 + epsilon))``.

    Args:
        image: ``(..., C, H, W)`` scene-linear radiance.
        reference: of the same shape.
        epsilon: in the unit of the radiance squared.

    Returns:
        ``(...)``, lower is better.

    Raises:
        ValueError: the shapes differ.

    Source: Rousselle et al. 2011.
    """
    _check(image, reference)
    scale = reference.mean(-3, keepdim=True).square() + epsilon
    return ((image - reference).square() / scale).mean((-3, -2, -1))


def psnr_srgb(image: Tensor, reference: Tensor) -> Tensor:
    """Peak signal-to-noise ratio as displayed: clamped to [0, 1], sRGB curve, peak 1.

    ``kornia.metrics.psnr`` on these values gives the same for one image; it averages a batch before the logarithm.

    Args:
        image: ``(..., 3, H, W)`` scene-linear radiance.
        reference: of the same shape.

    Returns:
        ``(...)`` decibels, higher is better; infinite for equal images.

    Raises:
        ValueError: the shapes differ.
    """
    _check(image, reference)
    difference = displayed(image) - displayed(reference)
    return -10 * torch.log10(difference.square().mean((-3, -2, -1)))


def displayed(image: Tensor) -> Tensor:
    """Scene-linear radiance as a display shows it: clamped to [0, 1], sRGB curve."""
    return linear_rgb_to_rgb(image.clamp(0, 1))


def _check(image: Tensor, reference: Tensor) -> None:
    if image.shape != reference.shape or image.ndim < 3:
        raise ValueError(
            f"reference: expected the shape of image and (..., C, H, W), found {tuple(reference.shape)} "
            f"for {tuple(image.shape)}"
        )
