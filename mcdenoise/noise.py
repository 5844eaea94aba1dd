"""How much noise a frame has, and whether that of neighbouring pixels is correlated, from the values of its pixels."""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.ops._constants import LEAST_SUM

_DARKEST, _BRIGHTEST = 0.02, 1e16  # smallest albedo to divide by, and largest radiance
_EVERY = 8  # rows and columns are examined at this distance
# Where a feature changes by this from pixel to pixel, differences may be those of the scene: their weight is the least.
_EVEN, _UNEVEN = 0.02, 0.01
# Smaller differences are rounding errors. Edges and fireflies should not outweigh the rest.
_ROUNDED, _LARGE = 1e-6, 0.1
# Fourth differences of independent noise of variance 1 have the variance 70, second differences 6.
_FOURTH = sqrt(70 / 6)
# Limits of the ratio of both differences. On shots of Mitsuba and Cycles, none of 104 with independent noise then has a
# spread of more than 0.5, and 35 of 40 with Gaussian, Mitchell and tent filters have; a nearly clean one and
# small ones with few even surfaces are missed.
_RATIO = (0.96, 0.88)
# Sum of differences that is added to both, so that few pixels tell nothing.
_FEW = 10.0
# Smallest difference that is noise, and limits of the fraction of noisy pixels, below which differences are those of
# the scene. Without a normal, which shows edges, differences of scenes are larger.
_LEAST, _LEAST_ALONE, _COMMON = 0.005, 0.04, (0.7, 0.8)


class Noise(NamedTuple):
    """Noise of a frame.

    Args:
        level: ``(B, 1, 1, 1)`` in [0, 1], the typical relative difference of pixels. It is 0.2 to 0.6 with one sample a
            pixel, about 0.15 with four, 0.08 with 16, and below 0.05 from 64 on. Details of the scene count, too.
        spread: ``(B, 1, 1, 1)`` from 0, for independent noise, to 1, for noise that neighbouring pixels share, because
            the film's filter counts each sample in several of them.
    """

    level: Tensor
    spread: Tensor


def noise_of(color: Tensor, albedo: Tensor | None = None, normal: Tensor | None = None) -> Noise:
    """Measure the noise of a frame, without a read of values on the host.

    Of five neighbours a to e in every eighth row and column of the demodulated radiance, with their sum
    ``m = a + b + 2 c + d + e``, the differences are ``near = sqrt(6 / 70) |a - 4 b + 6 c - 4 d + e| / m`` and
    ``wide = |a - 2 c + e| / m``. Both are equal in the mean if the noise of pixels is independent, and ``near`` is
    smaller if neighbours share it. Smooth shading has small fourth differences.

    With weights ``w = max(1 - g / 0.02, 0.01)``, where g is the largest change of a feature between neighbours, and
    0 where both differences are 0, as in a black background, the level is ``sum(w wide) / sum(w)``. With ``S(x) = 10 +
    sum(w x / (x + 0.1))`` the spread rises from 0 to 1 while the larger ratio ``S(near) / S(wide)`` of rows and of
    columns falls from 0.96 to 0.88, times the same for the fraction of pixels with ``wide`` above 0.005 (0.04 without
    a normal), which has to rise from 0.7 to 0.8: in clean images both differences are those of the scene.

    Args:
        color: ``(B, 3, H, W)`` noisy radiance; invalid values count as 0.
        albedo: ``(B, 3, H, W)``; ``None`` if there is none.
        normal: likewise, in any encoding.
    """
    dtype = torch.promote_types(color.dtype, torch.float32)
    images = [each.detach() for each in (color, albedo, normal) if each is not None]
    rows = [_valid(each[..., ::_EVERY, :].to(dtype)) for each in images]
    columns = [_valid(each[..., ::_EVERY].mT.to(dtype)) for each in images]
    known, least = albedo is not None, _LEAST_ALONE if normal is None else _LEAST
    both = [_sums(*each, known=known, least=least) for each in (rows, columns)]
    count, level, noisy = (both[0] + both[1])[:, :3].split(1, 1)
    count = count.clamp_min(LEAST_SUM)
    # A film's filter spreads samples along both axes.
    ratio = torch.maximum(*((near + _FEW) / (wide + _FEW) for near, wide in (each[:, 3:].split(1, 1) for each in both)))
    return Noise(level / count, _between(ratio, *_RATIO) * _between(noisy / count, *_COMMON))


def noise_is_spread(color: Tensor, albedo: Tensor | None, normal: Tensor | None = None) -> bool:
    """Whether neighbouring pixels have correlated noise; see :func:`noise_of` for the arguments.

    The answer is read on the host. It is yes if any image of a batch has such noise, and no for nearly clean frames.
    """
    return bool(noise_of(color, albedo, normal).spread.amax() > 0.5)


def _sums(color: Tensor, *features: Tensor, known: bool, least: float) -> Tensor:
    """Sums ``(B, 5, 1, 1)`` over pixels.

    These are the weights of the pixels, ``wide``, the weights of those where it is above ``least``, and both
    differences as far as they count. ``known`` tells whether the first of the features is the albedo.
    """
    light = color.clamp_min(0)
    if known:
        light = light / features[0].clamp_min(_DARKEST)
    a, b, c, d, e = _padded(light.mean(1, keepdim=True)).unfold(-1, 5, 1).unbind(-1)
    mean = (a + b + 2 * c + d + e).clamp_min(LEAST_SUM)
    near = (a - 4 * b + 6 * c - 4 * d + e).abs() / (_FOURTH * mean)
    wide = (a - 2 * c + e).abs() / mean
    weight = torch.ones_like(mean)
    if features:
        steps = _padded(torch.cat(features, 1)).diff(dim=-1).abs().amax(1, keepdim=True)
        weight = (1 - steps.unfold(-1, 4, 1).amax(-1) / _EVEN).clamp_min(_UNEVEN)
    weight = weight * (near + wide > _ROUNDED)
    counted = (torch.ones_like(wide), wide, wide > least, *(each / (each + _LARGE) for each in (near, wide)))
    return torch.cat([(weight * each).sum((1, 2, 3), keepdim=True) for each in counted], 1)


def _valid(image: Tensor) -> Tensor:
    return image.nan_to_num(0.0).clamp(-_BRIGHTEST, _BRIGHTEST)


def _padded(rows: Tensor) -> Tensor:
    """``(B, C, H, W)`` with two more pixels at both ends of each row."""
    return F.pad(rows, (2, 2, 0, 0), mode="replicate")


def _between(x: Tensor, start: float, end: float) -> Tensor:
    """0 at ``start``, 1 at ``end``, and beyond."""
    return ((x - start) / (end - start)).clamp(0, 1)
