"""How far an accumulated history lags behind the light: a test of its local mean against that of a shorter one."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.ops._check import check_kernel_size, check_positive, check_shapes
from mcdenoise.ops._constants import LAG_WINDOW, SMALLEST_LAG
from mcdenoise.ops._module import module_of
from mcdenoise.ops._numbers import unit_of
from mcdenoise.ops._window import accumulator_dtype

THRESHOLD = 2.0
KERNEL_SIZE = LAG_WINDOW


def history_lag(
    history: Tensor,
    recent: Tensor,
    variance: Tensor,
    *,
    threshold: float = THRESHOLD,
    kernel_size: int = KERNEL_SIZE,
) -> Tensor:
    """The fraction of a long history to replace by a shorter one, because the light has changed.

    Noise hides a change of the light in a pixel, but not in the mean of a window. With ``y`` the mean over channels,
    ``m_h`` and ``m_r`` its means over the ``n`` pixels of the window that lie in the image, of ``history`` and of
    ``recent``, and ``m_v`` that of ``variance``,

    ``z^2 = (m_r - m_h)^2 / (m_v / n + (0.001 (|m_h| + |m_r|) / 2)^2)``,
    ``lag = clamp((z^2 / threshold^2 - 1) / 3, 0, 1)``:

    0 up to ``threshold`` standard errors, 1 from twice as many. Detail is no lag: both means contain it.

    The variance must come from more than the window of ``recent``: where light arrives in few, large samples, a window
    that none has hit looks dark and free of noise. And radiance itself is a poor ``y``, since one firefly hides all
    else: a history is compared by means of its fourth root, with the variance over the history.

    Args:
        history: ``(B, C, H, W)`` mean over a long history, finite, any unit.
        recent: ``(B, C, H, W)`` mean over a shorter history, or the current frame, with more noise and less lag.
        variance: ``(B, 1, H, W)`` of the noise of ``recent``'s channel mean, at least 0, in its unit squared.
        threshold: standard errors up to which a difference is taken for noise, above 0.
        kernel_size: side of the window in pixels, odd, at least 3.

    Returns:
        ``(B, 1, H, W)`` fraction in [0, 1] in the dtype of ``history``: ``lerp(history, recent, lag)`` has no lag. Half
        precision is computed in float32. Below 1e-15 of the image's largest value nothing counts as lag.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: a shape or a setting does not fit.

    Differentiable in all three images, to any order, where the fraction is not exactly at its limits.

    Source: the idea of Schied et al. 2018, "Gradient estimation for real-time adaptive temporal filtering" (A-SVGF),
    and of the fast history of NVIDIA's ReLAX; with a test of means in place of re-shaded samples and of color boxes.

    Example:
        >>> history, variance = torch.ones(1, 3, 9, 9), torch.full((1, 1, 9, 9), 0.1)
        >>> history_lag(history, torch.zeros(1, 3, 9, 9), variance).unique().tolist()  # the light went out
        [1.0]
        >>> noise = torch.rand(1, 3, 9, 9, generator=torch.Generator().manual_seed(0)) * 2
        >>> history_lag(history, noise, variance).mean() < 0.01
        tensor(True)
    """
    check_shapes(history=(history, "B C H W"), recent=(recent, "B C H W"), variance=(variance, "B 1 H W"))
    _check_settings(threshold, kernel_size)
    if history.numel() == 0:
        return history[:, :1]
    dtype = accumulator_dtype(history.dtype)
    # Squares of numbers up to 1 do not overflow. The division comes before the sums, which could.
    largest = torch.maximum(history.detach().abs(), recent.detach().abs()).to(dtype).amax((1, 2, 3), keepdim=True)
    unit = unit_of(largest)
    long, short = ((image.to(dtype) / unit).mean(1, keepdim=True) for image in (history, recent))
    # Not the difference of the means, which cancels.
    mean, difference = _box(short, kernel_size), _box(short - long, kernel_size)
    height, width = history.shape[-2:]
    count = _count(height, kernel_size, mean)[:, None] * _count(width, kernel_size, mean)
    error = _box(variance.to(dtype) / unit / unit, kernel_size) / count
    smallest = SMALLEST_LAG * ((mean - difference).abs() + mean.abs()) / 2
    noise = threshold**2 * (error + smallest.square())
    some = noise > 0
    # Squared last: the derivative of a square over its noise overflows where both are small.
    ratio = torch.where(some, difference / torch.sqrt(torch.where(some, noise, 1)), 0).square()
    return ((ratio - 1) / 3).clamp(0, 1).to(history.dtype)


def _check_settings(threshold: float, kernel_size: int) -> None:
    check_positive(threshold=threshold)
    check_kernel_size(kernel_size, 3)


HistoryLag = module_of(history_lag, _check_settings)


def _box(image: Tensor, kernel_size: int) -> Tensor:
    """Mean over the pixels of each window that exist, along one axis at a time."""
    radius = kernel_size // 2
    image = F.avg_pool2d(image, (1, kernel_size), 1, (0, radius), count_include_pad=False)
    return F.avg_pool2d(image, (kernel_size, 1), 1, (radius, 0), count_include_pad=False)


def _count(length: int, kernel_size: int, like: Tensor) -> Tensor:
    """How many pixels of each window exist, along an axis of that length."""
    place, radius = torch.arange(length, dtype=like.dtype, device=like.device), kernel_size // 2
    return 1 + place.clamp_max(radius) + place.flip(0).clamp_max(radius)
