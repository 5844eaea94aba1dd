"""Errors of the change from frame to frame: without motion compensation, along the motion, and in static shots."""

from __future__ import annotations

import torch
from torch import Tensor

from mcdenoise.metrics.display import displayed
from mcdenoise.metrics.linear import smape_linear
from mcdenoise.metrics.metric import UncomputableError, check_clip, check_images
from mcdenoise.ops import Surface, reproject


def temporal_smape_linear(clip: Tensor, reference: Tensor, *, epsilon: float = 1e-2) -> Tensor:
    """SMAPE of the absolute differences between successive frames; it measures flicker and lag.

    With ``dx = |x_i - x_(i-1)|``, without motion compensation: ``mean(|dx - dy| / (dx + dy + epsilon))``.

    Args:
        clip: ``(..., T, C, H, W)`` scene-linear radiance of successive frames, T at least 2.
        reference: of the same shape.
        epsilon: small constant in the unit of the radiance.

    Returns:
        ``(...)`` in [0, 1], lower is better.

    Raises:
        ValueError: the shapes differ, or there are fewer than two frames.

    Source: Eq. 10 of the paper, doi:10.1007/s00371-023-02951-6.

    Example:
        >>> clip = torch.rand(4, 3, 2, 2)
        >>> temporal_smape_linear(clip + 1, clip).item() < 1e-4  # a constant error does not flicker
        True
    """
    check_clip(clip, reference)
    return smape_linear(clip.diff(dim=-4).abs(), reference.diff(dim=-4).abs(), epsilon=epsilon).mean(-1)


def temporal_rmse_srgb(clip: Tensor, reference: Tensor) -> Tensor:
    """Root mean squared error of displayed differences between successive frames; it measures flicker and lag.

    It is ``sqrt(mean(((x_i - x_(i-1)) - (y_i - y_(i-1)))^2))`` of values clamped to [0, 1] with the sRGB curve, without
    motion compensation, for each pair of frames; then the mean over the pairs. A constant error, however large, gives
    0.

    Args:
        clip: ``(..., T, 3, H, W)`` scene-linear radiance of successive frames, T at least 2.
        reference: of the same shape.

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
    """Warping error of one clip as displayed: how much a surface point changes from one frame to the next.

    It is ``sum(m |x_i - W x_(i-1)|^2) / sum(m)`` over the pixels, with the squared distance summed over R, G and B:
    ``W`` warps the previous frame along the motion (:func:`mcdenoise.ops.reproject`), and ``m`` in [0, 1] is the weight
    of the bilinear taps that pass the consistency test, 0 where the point was not visible before. It needs no
    reference. A reference has such an error too, because highlights and shadows move and warping blurs; a blurry result
    has a smaller one: compare it with the error of the reference, or use :func:`warped_rmse_srgb`.

    Args:
        clip: ``(B, 2, 3, H, W)`` scene-linear radiance of the previous and the current frame.
        motion: ``(B, 2, H, W)`` pixels, ``previous position = current position + motion``.
        surface: surfaces of the current frame, see :func:`mcdenoise.ops.reproject`; with ``None`` only the image border
            is tested.
        previous_surface: surfaces of the previous frame.

    Returns:
        ``(B,)`` in [0, 3], lower is steadier.

    Raises:
        ValueError: the clip is not a pair of frames, or shapes disagree.
        UncomputableError: no pixel has a history.

    Source: the flow warping error of Lai et al. 2018, Learning Blind Video Temporal Consistency, which uses an
    estimated optical flow and a binary mask.
    """
    return _warped_square(displayed(clip), motion, surface, previous_surface)


def warped_rmse_srgb(
    clip: Tensor,
    reference: Tensor,
    motion: Tensor,
    surface: Surface | None = None,
    previous_surface: Surface | None = None,
) -> Tensor:
    """Root mean squared error of the displayed change along the motion: flicker on moving surfaces.

    It is :func:`warping_error_srgb` with the reference's warped difference subtracted before squaring:
    ``sqrt(sum(m |(x_i - W x_(i-1)) - (y_i - W y_(i-1))|^2) / (3 sum(m)))``. A true change of a surface is no error, and
    an error that moves with its surface does not count. :func:`temporal_rmse_srgb` is its counterpart without motion.

    Args:
        clip: ``(B, 2, 3, H, W)`` scene-linear radiance of the previous and the current frame.
        reference: of the same shape.
        motion: see :func:`warping_error_srgb`.
        surface: see :func:`warping_error_srgb`.
        previous_surface: see :func:`warping_error_srgb`.

    Returns:
        ``(B,)`` in [0, 2], lower is better. The gradient is undefined where it is 0.

    Raises:
        ValueError: the clip is not a pair of frames, or shapes disagree.
        UncomputableError: no pixel has a history.

    Source: Lai et al. 2018, flow warping error; relative to the reference.
    """
    check_clip(clip, reference)
    error = displayed(clip) - displayed(reference)
    return (_warped_square(error, motion, surface, previous_surface) / 3).sqrt()


def _warped_square(clip: Tensor, motion: Tensor, surface: Surface | None, previous_surface: Surface | None) -> Tensor:
    """Mean squared length of current minus warped previous values, over the pixels that have a history."""
    if clip.ndim != 5 or clip.shape[1] != 2:
        raise ValueError(f"clip: expected (B, 2, 3, H, W), found {tuple(clip.shape)}")
    warped, weight = reproject(clip[:, 0], motion, surface, previous_surface)
    total = weight.sum((-3, -2, -1))
    if not bool((total > 0).all()):
        raise UncomputableError("warped differences: expected pixels with a history, found none")
    return (weight * (clip[:, 1] - warped).square()).sum((-3, -2, -1)) / total


class Flicker:
    """Flicker of a static shot: mean temporal standard deviation of the displayed values, minus the reference's.

    It is ``mean(std_t(x)) - mean(std_t(y))`` over pixels and channels of values clamped to [0, 1] with the sRGB curve,
    where the standard deviation is over the T frames with the divisor T. It is meaningful if neither the camera nor
    objects move. Moving lights contribute to both terms: a result that lags behind them can be below 0.

    Frames are added one by one, and memory does not grow with their number.

    Example:
        >>> flicker, still = Flicker(), torch.zeros(3, 1, 1)
        >>> for image in (still, still + 1):
        ...     flicker.add(image, still)
        >>> round(flicker.value().item(), 6)
        0.5
    """

    def __init__(self) -> None:
        self.frames = 0
        # Mean and sum of squared deviations, of the images and of their references.
        self._mean = self._square = torch.zeros((), dtype=torch.float32, device="cpu")

    def add(self, image: Tensor, reference: Tensor) -> None:
        """Add the next frame: ``(..., 3, H, W)`` scene-linear radiance, and its reference.

        Raises:
            ValueError: the shapes differ.
        """
        check_images(image, reference)
        both = torch.stack([displayed(image), displayed(reference)])
        # Use Welford's update, because differences of squares would cancel for a converged image.
        self.frames += 1
        change = both - self._mean
        self._mean = self._mean + change / self.frames
        self._square = self._square + change * (both - self._mean)

    def value(self) -> Tensor:
        """``(...)`` flicker of the frames so far, at least two, in [-0.5, 0.5]; closer to 0 is better."""
        deviation = (self._square / self.frames).clamp_min(0).sqrt().mean((-3, -2, -1))
        return deviation[0] - deviation[1]
