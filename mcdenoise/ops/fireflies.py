"""Clamp fireflies: single pixels that are far brighter than everything around them."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise.ops._check import check_shapes
from mcdenoise.ops._window import accumulator_dtype

# At one sample a pixel ordinary noise exceeds its neighbours' mean tenfold; what exceeds it thirtyfold rarely helps.
LIMIT = 30.0
KERNEL_SIZE = 7


def clamp_fireflies(image: Tensor, *, limit: float = LIMIT, kernel_size: int = KERNEL_SIZE) -> Tensor:
    """Scale down every pixel that is brighter than ``limit`` times the mean of its neighbours, and keep its hue.

    With ``y`` the mean over the channels and ``n[p]`` the mean of ``y`` over the other pixels of the window around
    ``p`` that lie in the image, ``out[p] = image[p] * min(1, limit * n[p] / y[p])``. A path that found a small bright
    light by chance costs a denoiser more than it tells: in an accumulated history it stays for many frames. What is
    lost is energy, of exactly those paths, and that of a light of one or two pixels in dark surroundings. Bright pixels
    in the same window protect each other: with the defaults, away from the border, two keep 5/8 of themselves, and
    three keep everything.

    Args:
        image: ``(B, C, H, W)`` noisy radiance, finite and non-negative, any unit; usually demodulated.
        limit: how many times as bright as its neighbours' mean a pixel may be, above 0; infinity changes nothing.
        kernel_size: side of the window in pixels, odd, at least 3.

    Returns:
        ``(B, C, H, W)`` in the dtype of ``image``; what is below the limit is equal bit by bit. Half precision is
        summed in float32. Holds from black to 1e30, to rounding also where both are in one window. An image of one
        pixel has no neighbours and is returned as it is.

    Raises:
        TypeError: the image is no floating-point tensor.
        ValueError: a shape or a setting does not fit.

    Differentiable in ``image`` where no pixel is exactly at its limit, to any order.

    Source: no paper's; the usual clamp of single samples, with the neighbours' mean for a limit.

    Example:
        >>> image = torch.ones(1, 3, 5, 5)
        >>> image[..., 2, 2] = 1e6
        >>> clamp_fireflies(image)[0, :, 2, 2].tolist()
        [30.0, 30.0, 30.0]
    """
    sizes = check_shapes(image=(image, "B C H W"))
    _check_settings(limit, kernel_size)
    if limit == math.inf or image.numel() == 0 or sizes["H"] * sizes["W"] == 1:
        return image
    source = image.to(accumulator_dtype(image.dtype))
    # Of the brightness only ratios matter, so it is scaled to where no sum overflows: by a power of two, which rounds
    # nothing. Channel by channel, since a reduction over them is slow where they lie beside each other.
    first, *others = source.unbind(1)
    scale = 2.0 ** -((1 + len(others)) * kernel_size**2).bit_length()
    brightness = first * scale
    for channel in others:
        brightness = torch.add(brightness, channel, alpha=scale)
    brightness = brightness[:, None]
    around, count = _neighbours(brightness, kernel_size // 2)
    # Finite in the dtype: infinity times dark neighbours would be NaN.
    highest = around * (min(limit, torch.finfo(source.dtype).max) / count)
    bright = brightness > highest
    # Divided first: the ratio of the limit to a very bright pixel, and of that its derivative, is too small a number.
    clamped = source / torch.where(bright, brightness, 1) * highest
    return torch.where(bright, clamped, source).to(image.dtype)


class ClampFireflies(nn.Module):
    """:func:`clamp_fireflies` with its settings stored.

    Args:
        limit: see :func:`clamp_fireflies`.
        kernel_size: see :func:`clamp_fireflies`.
    """

    def __init__(self, limit: float = LIMIT, kernel_size: int = KERNEL_SIZE) -> None:
        super().__init__()
        _check_settings(limit, kernel_size)
        self.limit = limit
        self.kernel_size = kernel_size

    def forward(self, image: Tensor) -> Tensor:
        """See :func:`clamp_fireflies`."""
        return clamp_fireflies(image, limit=self.limit, kernel_size=self.kernel_size)


def _check_settings(limit: float, kernel_size: int) -> None:
    if not limit > 0:
        raise ValueError(f"limit: expected above 0, found {limit}")
    if kernel_size < 3 or kernel_size % 2 == 0:
        raise ValueError(f"kernel_size: expected odd and at least 3, found {kernel_size}")


def _neighbours(values: Tensor, radius: int) -> tuple[Tensor, Tensor]:
    """Sum over each pixel's window without the pixel itself, and the number of those pixels, ``(H, W)``.

    The hole is never summed: subtracted again, a very bright pixel would take its neighbours' digits with it. Nor is
    this a convolution, which takes many times as long on a CPU and may be rounded to TF32 on a GPU.
    """
    beside = _both_sides(values, radius, -1)
    around = _both_sides(beside + values, radius, -2)
    around += beside
    rows, columns = (_inside(size, radius, values) for size in values.shape[-2:])
    return around, rows[:, None] * columns - 1


def _both_sides(values: Tensor, radius: int, dim: int) -> Tensor:
    """Sum of the ``radius`` values before and the ``radius`` values after each, along one of the last two axes."""
    size = values.shape[dim]
    reach = size + radius + 1
    padded = F.pad(values, (radius, radius) if dim == -1 else (0, 0, radius, radius))
    run = padded.narrow(dim, 0, reach)
    for start in range(1, radius):
        # The second in place, and those after it: fresh memory takes longer than the sum.
        run = run + padded.narrow(dim, start, reach) if start == 1 else run.add_(padded.narrow(dim, start, reach))
    return run.narrow(dim, 0, size) + run.narrow(dim, radius + 1, size)


def _inside(size: int, radius: int, like: Tensor) -> Tensor:
    """How many of the ``2 radius + 1`` values around each of ``size`` values exist."""
    index = torch.arange(size, device=like.device)
    return ((index + radius).clamp_max(size - 1) - (index - radius).clamp_min(0) + 1).to(like.dtype)
