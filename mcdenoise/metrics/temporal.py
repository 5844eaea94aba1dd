"""Errors of the change between frames: without motion compensation, along the motion, and in static shots."""

from __future__ import annotations

import torch
from torch import Tensor

from mcdenoise.metrics._check import UncomputableError, check_clip, check_images
from mcdenoise.metrics.display import displayed
from mcdenoise.metrics.linear import smape_linear
from mcdenoise.ops import Surface, reproject


def temporal_smape_linear(clip: Tensor, reference: Tensor, *, epsilon: float = 1e-2) -> Tensor:
    """SMAPE of the absolute differences between consecutive frames, which measures flicker and lag.

    With ``dx = |x_i - x_(i-1)|``, not motion-compensated: ``mean(|dx - dy| / (dx + dy + epsilon))``.

    Args:
        clip: ``(..., T, C, H, W)`` scene-linear radiance of consecutive frames, T at least 2.
        reference: the same shape.
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
    check_clip(clip, reference)
    return smape_linear(clip.diff(dim=-4).abs(), reference.diff(dim=-4).abs(), epsilon=epsilon).mean(-1)


def temporal_rmse_srgb(clip: Tensor, reference: Tensor) -> Tensor:
    """Root mean squared error of displayed differences between consecutive frames, which measures flicker and lag.

    ``sqrt(mean(((x_i - x_(i-1)) - (y_i - y_(i-1)))^2))`` of values clamped to [0, 1] on the sRGB curve, not
    motion-compensated, for each pair of frames; then the mean over the pairs. A constant error does not count.

    Args:
        clip: ``(..., T, 3, H, W)`` scene-linear radiance of consecutive frames, T at least 2.
        reference: the same shape.

    Returns:
        ``(...)`` in [0, 2], lower is better. The gradient is undefined where it is 0.

    Raises:
        ValueError: the shapes differ, or there are fewer than two frames.

    Example:
        >>> clip = torch.rand(4, 3, 2, 2)
        >>> temporal_rmse_srgb(clip, clip).item()
        0.0
    """
    check_clip(clip, reference)
    error = displayed(clip) - displayed(reference)
    return error.diff(dim=-4).square().mean((-3, -2, -1)).sqrt().mean(-1)


def warping_error_srgb(
    clip: Tensor, motion: Tensor, surface: Surface | None = None, previous_surface: Surface | None = None
) -> Tensor:
    """Warping error of one displayed clip: how much a surface point changes from one frame to the next.

    ``sum(m |x_i - W x_(i-1)|^2) / sum(m)`` over the pixels, with the squared distance summed over R, G and B. ``W``
    reprojects the previous frame along the motion (:func:`mcdenoise.ops.reproject`), and ``m`` in [0, 1] is the weight
    of the four bilinear taps that pass its consistency test, 0 where the point was not visible before. No reference is
    needed. But a reference also has such an error (highlights and shadows move, and reprojection blurs), and a blurry
    result has a smaller one: compare with the reference's error, or use :func:`warped_rmse_srgb`.

    Args:
        clip: ``(B, 2, 3, H, W)`` scene-linear radiance of the previous and the current frame.
        motion: ``(B, 2, H, W)`` pixels, ``previous position = current position + motion``.
        surface: surface of the current frame, see :func:`mcdenoise.ops.reproject`; ``None`` tests only for the border.
        previous_surface: surface of the previous frame.

    Returns:
        ``(B,)`` in [0, 3], lower is steadier.

    Raises:
        ValueError: the clip is not a pair of frames, or shapes do not match.
        UncomputableError: no pixel has a history.

    Source: Lai et al. 2018, Learning Blind Video Temporal Consistency, flow warping error: there the motion is an
    estimated optical flow and the mask binary.
    """
    return _warped_square(displayed(clip), motion, surface, previous_surface)


def warped_rmse_srgb(
    clip: Tensor,
    reference: Tensor,
    motion: Tensor,
    surface: Surface | None = None,
    previous_surface: Surface | None = None,
) -> Tensor:
    """Root mean squared error of the change along the motion, as displayed: flicker that does not follow surfaces.

    This is :func:`warping_error_srgb` with the reference's warped difference subtracted before squaring,
    ``sqrt(sum(m |(x_i - W x_(i-1)) - (y_i - W y_(i-1))|^2) / (3 sum(m)))``. So real changes on a surface are not
    counted, nor is an error that moves with its surface; :func:`temporal_rmse_srgb` is the same without motion.

    Args:
        clip: ``(B, 2, 3, H, W)`` scene-linear radiance of the previous and the current frame.
        reference: the same shape.
        motion: see :func:`warping_error_srgb`.
        surface: see :func:`warping_error_srgb`.
        previous_surface: see :func:`warping_error_srgb`.

    Returns:
        ``(B,)`` in [0, 2], lower is better. The gradient is undefined where it is 0.

    Raises:
        ValueError: the clip is not a pair of frames, or shapes do not match.
        UncomputableError: no pixel has a history.

    Source: Lai et al. 2018, flow warping error; relative to the reference.
    """
    check_clip(clip, reference)
    error = displayed(clip) - displayed(reference)
    return (_warped_square(error, motion, surface, previous_surface) / 3).sqrt()


def _warped_square(clip: Tensor, motion: Tensor, surface: Surface | None, previous_surface: Surface | None) -> Tensor:
    """Mean squared length of current minus warped previous values, over the pixels with a history."""
    if clip.ndim != 5 or clip.shape[1] != 2:
        raise ValueError(f"clip: expected (B, 2, 3, H, W), found {tuple(clip.shape)}")
    warped, weight = reproject(clip[:, 0], motion, surface, previous_surface)
    total = weight.sum((-3, -2, -1))
    if not bool((total > 0).all()):
        raise UncomputableError("warped differences: expected pixels that were seen in the frame before, found none")
    return (weight * (clip[:, 1] - warped).square()).sum((-3, -2, -1)) / total


def flicker_srgb(clip: Tensor, reference: Tensor) -> Tensor:
    """Flicker of a static shot: mean temporal standard deviation of the displayed values, minus the reference's.

    ``mean(std_t(x)) - mean(std_t(y))`` over pixels and channels of values clamped to [0, 1] on the sRGB curve; the
    standard deviation is over the T frames, with the divisor T. It is meaningful if neither camera nor objects move.
    Moving lights contribute to both terms: a result that lags behind them can be below 0.

    Args:
        clip: ``(..., T, 3, H, W)`` scene-linear radiance of consecutive frames, T at least 2.
        reference: the same shape.

    Returns:
        ``(...)`` in [-0.5, 0.5], closer to 0 is better.

    Raises:
        ValueError: the shapes differ, or there are fewer than two frames.

    Example:
        >>> still = torch.zeros(2, 3, 1, 1)
        >>> round(flicker_srgb(torch.stack([still[0], still[0] + 1]), still).item(), 6)
        0.5
    """
    check_clip(clip, reference)
    flicker = Flicker()
    for image, expected in zip(clip.unbind(-4), reference.unbind(-4), strict=True):
        flicker.add(image, expected)
    return flicker.value()


class Flicker:
    """Computes :func:`flicker_srgb` frame by frame, with two sums per image whatever the length of the shot."""

    def __init__(self) -> None:
        self.frames = 0
        # One sum for the images and one for their references.
        self._mean = self._square = torch.zeros((), dtype=torch.float32, device="cpu")

    def add(self, image: Tensor, reference: Tensor) -> None:
        """Add the next frame: ``(..., 3, H, W)`` scene-linear radiance, and its reference."""
        check_images(image, reference)
        both = torch.stack([displayed(image), displayed(reference)])
        # Welford's update: a difference of sums of squares would lose the small flicker of a converged image.
        self.frames += 1
        change = both - self._mean
        self._mean = self._mean + change / self.frames
        self._square = self._square + change * (both - self._mean)

    def value(self) -> Tensor:
        """The flicker ``(...)`` of all frames so far."""
        deviation = (self._square / self.frames).clamp_min(0).sqrt().mean((-3, -2, -1))
        return deviation[0] - deviation[1]
