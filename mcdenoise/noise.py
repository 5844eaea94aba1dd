"""How much noise a frame has, and whether that of neighbouring pixels is correlated, from the values of its pixels."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from mcdenoise.frame import Frame
from mcdenoise.ops._steps.noise import LEAST_SUM, noise_sums

# Limits of the ratio of both differences. On shots of Mitsuba and Cycles, none of 104 with independent noise then has a
# spread of more than 0.3, and 37 of 40 with Gaussian, Mitchell and tent filters have; three small ones with few even
# surfaces are missed.
_RATIO = (0.96, 0.88)
# Spread from which neighbours count as sharing their noise. To miss that does more harm than to assume it.
_SHARED = 0.35
# Sum of differences that is added to both, so that few pixels tell nothing.
_FEW = 10.0
# Smallest difference that is noise, and limits of the fraction of noisy pixels, below which differences are those of
# the scene. Without a normal, which shows edges, differences of scenes are larger.
_LEAST, _LEAST_ALONE, _COMMON = 0.005, 0.04, (0.7, 0.8)


# Two frames have equal noise if so many of their lit pixels are equal but for rounding to half precision, out of one in
# 16, and there is noise: a level that no converged frame of 9 scenes has (0.08 at most, without features 0.13).
_EQUAL, _HALF, _EVERY, _LEAST_LIT = 0.9, 2.0**-10, 4, 16
_REPEATED, _REPEATED_ALONE = 0.1, 0.15


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
    least = _LEAST_ALONE if normal is None else _LEAST
    with torch.no_grad():
        weight, level, noisy, near, wide = noise_sums(color, albedo, normal, least).unbind(-1)
    count = weight.sum(1).clamp_min(LEAST_SUM)
    # A film's filter spreads samples along both axes.
    ratio = ((near + _FEW) / (wide + _FEW)).amax(1)
    spread = _between(ratio, *_RATIO) * _between(noisy.sum(1) / count, *_COMMON)
    return Noise((level.sum(1) / count).reshape(-1, 1, 1, 1), spread.reshape(-1, 1, 1, 1))


def noise_is_spread(color: Tensor, albedo: Tensor | None, normal: Tensor | None = None) -> bool:
    """Whether neighbouring pixels have correlated noise; see :func:`noise_of` for the arguments.

    The answer is read on the host. It is yes if any image of a batch has such noise, and no for nearly clean frames.
    """
    return bool(noise_of(color, albedo, normal).spread.amax() > _SHARED)


def thinned(frame: Frame) -> Frame:
    """A copy of one pixel in 16 of what :func:`noise_is_repeated` compares."""
    position = None if frame.position is None else frame.position[..., ::_EVERY, ::_EVERY].clone()
    color = frame.color.detach()[..., ::_EVERY, ::_EVERY].clone()
    camera = frame.view_projection
    return Frame(color, position=position, view_projection=None if camera is None else camera.clone())


def noise_is_repeated(frame: Frame, seen: Frame, before: Frame) -> bool:
    """Whether nothing moves in a frame, and it has the noise of the frame before, as of a renderer with a fixed seed.

    The answer is read on the host. It is no for converged frames, which may be equal.

    Args:
        frame: the frame.
        seen: the same, :func:`thinned`.
        before: the frame before, thinned.
    """
    if before.color.shape != seen.color.shape:
        return False
    lit = (seen.color > 0).any(1)
    same = lit & ((seen.color - before.color).abs() <= _HALF * before.color).all(1)
    if int(lit.sum()) < _LEAST_LIT or float(same.sum()) < _EQUAL * float(lit.sum()):
        return False
    if frame.motion is not None:
        still = not frame.motion.any()
    else:
        pairs = (seen.position, before.position), (seen.view_projection, before.view_projection)
        still = all(a is not None and b is not None and torch.equal(a, b) for a, b in pairs)
    if not still:
        return False
    alone = frame.albedo is None or frame.normal is None
    level = noise_of(frame.color, frame.albedo, frame.normal).level.amin()
    return bool(level > (_REPEATED_ALONE if alone else _REPEATED))


def _between(x: Tensor, start: float, end: float) -> Tensor:
    """0 at ``start``, 1 at ``end``, and beyond."""
    return ((x - start) / (end - start)).clamp(0, 1)
