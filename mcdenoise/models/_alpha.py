"""The noise of an alpha: how much there is, and alpha without it.

Wherever a surface covers a pixel partly, at hair, out of focus, in motion, a path hits or misses it by chance: that is
noise in alpha as in color. The light of the surface does not tell where the surface ends, so alpha is its own guide.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.ops import cross_bilateral_filter
from mcdenoise.ops._window import taps

# Directions in which an edge may run: its alpha is a straight line in one of them.
_DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (2, 1), (1, -2), (2, -1))
# Mean of the least of eight squared second differences of noise, for one unit of its variance.
_LEAST = 0.91
# White noise has this fraction of its variance left in means of 2x2 pixels, edges and strands more than 1 / 1.75.
_COARSER, _EDGES = 0.25, 1.75
# Side of the window in which noise is measured: in smaller ones, some details without noise look like it.
_AROUND = 33
# Side of the filter's window, and the width of the falloff with the difference of patches, in deviations of the noise.
_SIDE, _FALLOFF = 7, 0.6


def noise_of_alpha(alpha: Tensor) -> Tensor:
    """The variance of an alpha of ``a`` by the noise of samples, as a fraction of ``a (1 - a)``: 1 / samples.

    It is that of second differences in the direction in which they are least, at which a coarser image has less than
    the finer one. It is 0 for an alpha without noise, and mostly for details of which noise cannot be told.

    Args:
        alpha: ``(B, 1, H, W)`` in [0, 1].

    Returns:
        ``(B, 1, H, W)`` in [0, 1]: that of the pixels around each.
    """
    coarse = F.avg_pool2d(F.pad(alpha, (0, 1, 0, 1), mode="replicate"), 2, 1)
    mean = _mean(alpha)
    possible = mean * (1 - mean)
    change = _least_change(alpha, 1) - _EDGES * _least_change(coarse, 2)
    found, most = (
        F.avg_pool2d(torch.where(possible > 1e-3, image, 0), _AROUND, 1, _AROUND // 2) for image in (change, possible)
    )
    return (found / ((1 - _EDGES * _COARSER) * _LEAST * most).clamp_min(1e-9)).clamp(0, 1).detach()


def without_noise(alpha: Tensor, noise: Tensor) -> Tensor:
    """The mean of the pixels around, as far as their patches of 3x3 pixels differ by noise only.

    Where there is no noise, alpha stays, and where such a patch is all 0 or all 1. These are not averaged with others:
    what sparse alpha gave to them would be lost.

    Args:
        alpha: ``(B, 1, H, W)`` in [0, 1].
        noise: result of :func:`noise_of_alpha`.

    Source: Buades et al. 2005, "A non-local algorithm for image denoising".
    """
    mean = _mean(alpha)
    whole = (mean <= 0) | (mean >= 1)
    # No patches differ as much as those of pixels that stay do from the others.
    patches = torch.cat([*(tap / 3 for tap in taps(alpha, 3, "replicate")), 1e3 * whole], 1)
    variance = noise * mean * (1 - mean)
    # Noise alone makes patches differ by twice its variance, but no patch from itself.
    others = _SIDE**2 // 2
    logits = F.pad(alpha.new_full((1, 1, 1, 1), -1 / _FALLOFF**2), (0, 0, 0, 0, others, others))
    falloff = 1 / (2 * _FALLOFF**2 * variance + 1e-8)
    kernel = logits.expand(len(alpha), -1, *alpha.shape[-2:])
    smooth = cross_bilateral_filter(alpha, kernel, [patches], [falloff], border="renormalize")
    return torch.where(whole | (noise <= 0), alpha, smooth.clamp(0, 1))


def _mean(alpha: Tensor) -> Tensor:
    # A mean of ones must be one.
    return F.avg_pool2d(F.pad(alpha, (1, 1, 1, 1), mode="replicate"), 3, 1).clamp(0, 1)


def _least_change(image: Tensor, step: int) -> Tensor:
    """The least squared second difference over the directions, for noise of variance 1 that of :data:`_LEAST`."""
    height, width = image.shape[-2:]
    reach = 2 * step
    padded = F.pad(image, (reach, reach, reach, reach), mode="replicate")

    def at(y: int, x: int) -> Tensor:
        return padded[..., reach + y * step :, reach + x * step :][..., :height, :width]

    least = torch.full_like(image, torch.inf)
    for y, x in _DIRECTIONS:
        least = torch.minimum(least, (at(y, x) + at(-y, -x) - 2 * image).square())
    return least
