"""Clamp fireflies: single pixels that are far brighter than everything around them."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.ops._check import check_kernel_size, check_positive, check_shapes
from mcdenoise.ops._module import module_of
from mcdenoise.ops._window import accumulator_dtype

# At one sample a pixel ordinary noise is up to ten times as bright as the lit pixels around it.
LIMIT = 15.0
KERNEL_SIZE = 7


def clamp_fireflies(image: Tensor, *, limit: float | Tensor = LIMIT, kernel_size: int = KERNEL_SIZE) -> Tensor:
    """Scale down every pixel that is brighter than ``limit`` times the mean of its lit neighbours, and keep its hue.

    With ``y`` the mean over the channels and ``n[p]`` the mean of ``y`` over the other pixels of the window around
    ``p`` that lie in the image and are not black, ``out[p] = image[p] * min(1, limit * n[p] / y[p])``; without any such
    neighbour ``out[p] = image[p]``. A path that found a small bright light by chance does a denoiser more harm than
    good: in an accumulated history it stays for many frames. The result lacks the energy of exactly those paths.

    Black pixels do not count, because they do not tell how bright the paths are that find light. Where one path in
    fifty finds it, all the light is in pixels fifty times as bright as the mean of their neighbourhood; a limit that is
    useful elsewhere would remove it.

    Args:
        image: ``(B, C, H, W)`` noisy radiance, finite and non-negative, any unit; usually demodulated.
        limit: how many times as bright as its neighbours' mean a pixel may be, above 0; infinity changes nothing. A
            number, or ``(B, 1, 1, 1)`` of each image, whose values are not checked.
        kernel_size: side of the window in pixels, odd, at least 3.

    Returns:
        ``(B, C, H, W)`` in the dtype of ``image``; pixels below the limit are equal bit by bit. Half precision is
        summed in float32. Exact to rounding for radiance from 0 to 1e30, also where both are in one window. Denormal
        numbers may count as black.

    Raises:
        TypeError: the image is no floating-point tensor.
        ValueError: a shape or a setting does not fit.

    Differentiable in ``image`` where no pixel is exactly at its limit and none is black, to any order.

    Source: no paper; the usual clamp of single samples, relative to the mean of the lit neighbours.

    Example:
        >>> image = torch.ones(1, 3, 5, 5)
        >>> image[..., 2, 2] = 1e6
        >>> clamp_fireflies(image)[0, :, 2, 2].tolist()
        [15.0, 15.0, 15.0]
    """
    check_shapes(image=(image, "B C H W"), limit=(limit if isinstance(limit, Tensor) else None, "[B 1 1 1]"))
    _check_settings(limit, kernel_size)
    if image.numel() == 0 or (not isinstance(limit, Tensor) and limit == math.inf):
        return image
    source = image.to(accumulator_dtype(image.dtype))
    # Only ratios of brightness matter, so it is scaled down by a power of two, which rounds nothing, and no sum
    # overflows. The channels are added one by one, since a reduction over them is slow where they lie side by side.
    first, *others = source.unbind(1)
    scale = 2.0 ** -((1 + len(others)) * kernel_size**2).bit_length()
    brightness = first * scale
    for channel in others:
        brightness = torch.add(brightness, channel, alpha=scale)
    brightness = brightness[:, None]
    radius = kernel_size // 2
    around, lit = _neighbours(brightness, radius), _neighbours((brightness > 0).to(source.dtype), radius)
    # The limit must be finite: infinity times dark neighbours, or times a derivative of zero, would be NaN.
    largest = torch.finfo(source.dtype).max
    bound = limit.to(source.dtype).clamp_max(largest) if isinstance(limit, Tensor) else min(limit, largest)
    highest = (around * (lit.clamp_min(1).reciprocal() * bound)).clamp_max(largest)
    bright = (brightness > highest) & (lit > 0)
    if isinstance(limit, Tensor):
        bright = bright & (limit < math.inf)
    # The division comes first: the ratio of the limit to a very bright pixel may underflow, and its derivative, too.
    clamped = source / torch.where(bright, brightness, 1) * highest
    return torch.where(bright, clamped, source).to(image.dtype)


def _check_settings(limit: float | Tensor, kernel_size: int) -> None:
    if not isinstance(limit, Tensor):
        check_positive(limit=limit)
    check_kernel_size(kernel_size, 3)


ClampFireflies = module_of(clamp_fireflies, _check_settings)


def _neighbours(values: Tensor, radius: int) -> Tensor:
    """Sum over each pixel's window without the pixel itself.

    The pixel itself is never added: subtracting a very bright one again would cancel the digits of its neighbours. This
    is no convolution, because that takes many times as long on a CPU and may be rounded to TF32 on a GPU.
    """
    beside = _both_sides(values, radius, -1)
    around = _both_sides(beside + values, radius, -2)
    around += beside
    return around


def _both_sides(values: Tensor, radius: int, dim: int) -> Tensor:
    """Sum of the ``radius`` values before and the ``radius`` values after each, along one of the last two axes."""
    size = values.shape[dim]
    reach = size + radius + 1
    padded = F.pad(values, (radius, radius) if dim == -1 else (0, 0, radius, radius))
    run = padded.narrow(dim, 0, reach)
    for start in range(1, radius):
        # All but the first sum are in place: allocating memory takes longer than adding.
        run = run + padded.narrow(dim, start, reach) if start == 1 else run.add_(padded.narrow(dim, start, reach))
    return run.narrow(dim, 0, size) + run.narrow(dim, radius + 1, size)
