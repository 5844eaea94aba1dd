"""How much noise a frame has, and whether that of neighbouring pixels is correlated, from the values of its pixels."""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.ops._constants import LEAST_SUM

_DARKEST = 0.02  # smallest albedo to divide by
_EVERY = 8  # rows and columns are examined at this distance
# Where a feature changes by this from pixel to pixel, differences may be those of the scene: their weight is the least.
_EVEN, _UNEVEN = 0.02, 0.01
# A difference d counts as d / (d + 0.1), so that edges and fireflies do not outweigh the rest.
_LARGE = 0.1
# Fourth differences of independent noise of variance 1 have the variance 70, second differences 6.
_FOURTH = sqrt(70 / 6)
# The ratio was at least 0.95 with independent noise, and at most 0.89 with Gaussian, Mitchell and tent filters, on 78
# shots of Mitsuba and Cycles.
_RATIO = (0.95, 0.85)
# Sum of differences that is added to both, so that few pixels tell nothing.
_FEW = 20.0
# Smallest difference that is noise, and the fraction of noisy pixels below which differences are those of the scene.
# Without a normal, which shows edges, differences of scenes are larger.
_LEAST, _LEAST_ALONE, _NOISY = 0.005, 0.04, (0.65, 0.8)


class Noise(NamedTuple):
    """Noise of a frame.

    Args:
        level: ``(B, 1, 1, 1)`` typical relative difference of pixels: 0.35 to 0.5 with one sample a pixel, 0.1 with
            some ten, below 0.04 for nearly clean frames; details of the scene count, too.
        spread: ``(B, 1, 1, 1)`` from 0, for independent noise, to 1, for noise that neighbouring pixels share, because
            the film's filter counts each sample in several of them.
    """

    level: Tensor
    spread: Tensor


def noise_of(color: Tensor, albedo: Tensor | None = None, normal: Tensor | None = None) -> Noise:
    """Measure the noise of a frame, without a read of values on the host.

    Of five neighbours a to e of a row or column of the demodulated radiance, let ``m = a + b + 2 c + d + e``,
    ``near = sqrt(6 / 70) |a - 4 b + 6 c - 4 d + e| / m`` and ``wide = |a - 2 c + e| / m``. Where albedo and normal are
    even, the mean of ``wide`` is the level. Both differences are equal in the mean if the noise of pixels is
    independent, and ``near`` is smaller if neighbours share it. Smooth shading has small fourth differences.

    Args:
        color: ``(B, 3, H, W)`` noisy radiance, finite.
        albedo: ``(B, 3, H, W)``, finite; ``None`` if there is none.
        normal: likewise, in any encoding.
    """
    dtype = torch.promote_types(color.dtype, torch.float32)
    images = [each.detach() for each in (color, albedo, normal) if each is not None]
    rows = [each[..., ::_EVERY, :].to(dtype) for each in images]
    columns = [each[..., ::_EVERY].mT.to(dtype) for each in images]
    known, least = albedo is not None, _LEAST_ALONE if normal is None else _LEAST
    sums = _sums(*rows, known=known, least=least) + _sums(*columns, known=known, least=least)
    count, level, noisy, near, wide = sums.clamp_min(LEAST_SUM).split(1, 1)
    return Noise(level / count, _between((near + _FEW) / (wide + _FEW), *_RATIO) * _between(noisy / count, *_NOISY))


def noise_is_spread(color: Tensor, albedo: Tensor | None, normal: Tensor | None = None) -> bool:
    """Whether neighbouring pixels have correlated noise; see :func:`noise_of` for the arguments.

    The answer is read on the host. It is no for nearly clean frames.
    """
    return bool(noise_of(color, albedo, normal).spread.amax() > 0.5)


def _sums(color: Tensor, *features: Tensor, known: bool, least: float) -> Tensor:
    """Sums ``(B, 5, 1, 1)`` over pixels.

    These are the weights of the pixels, ``wide``, the weights of those where it is above ``least``, and both
    differences as far as they count. ``known`` tells whether the first of the features is the albedo.
    """
    light = color / features[0].clamp_min(_DARKEST) if known else color
    a, b, c, d, e = _padded(light.mean(1, keepdim=True)).unfold(-1, 5, 1).unbind(-1)
    mean = (a + b + 2 * c + d + e).clamp_min(LEAST_SUM)
    near = (a - 4 * b + 6 * c - 4 * d + e).abs() / (_FOURTH * mean)
    wide = (a - 2 * c + e).abs() / mean
    weight = torch.ones_like(mean)
    if features:
        steps = _padded(torch.cat(features, 1)).diff(dim=-1).abs().amax(1, keepdim=True)
        weight = (1 - steps.unfold(-1, 4, 1).amax(-1) / _EVEN).clamp_min(_UNEVEN)
    counted = (torch.ones_like(wide), wide, wide > least, *(each / (each + _LARGE) for each in (near, wide)))
    return torch.cat([(weight * each).sum((1, 2, 3), keepdim=True) for each in counted], 1)


def _padded(rows: Tensor) -> Tensor:
    """``(B, C, H, W)`` with two more pixels at both ends of each row."""
    return F.pad(rows, (2, 2, 0, 0), mode="replicate")


def _between(x: Tensor, start: float, end: float) -> Tensor:
    """0 at ``start``, 1 at ``end``, and beyond."""
    return ((x - start) / (end - start)).clamp(0, 1)
