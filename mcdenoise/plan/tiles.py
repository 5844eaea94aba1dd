"""Tiles of a still shot that need no network: their noise is gone, or nothing has changed."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.buffers import Frame

TILE = 32
# One pixel in 16 says enough of a tile's noise, and whether it is worth while to look at all of them.
_STRIDE = 4
# Tiles on each side that count for a network. Its lowest resolution sees twice as far, but what changes there moves a
# result by no more than what it does to the exposure of the whole image.
_SEEN = 4
# A tile that is passed through comes back only when it is noisier than it had to be by this factor.
_NOISE_HYSTERESIS = 2.0
# A tile may change by this share of the tolerance from frame to frame before it is reused, and in all by the tolerance.
_CHANGE_HYSTERESIS = 0.25
# Relative difference between a frame and the accumulated image below which it says nothing of the noise.
_LEAST_RESIDUAL = 1e-4
# Frames from which the noise can be told.
_LEAST_LENGTH = 8
# How much a network's result changes, relatively, with the share that a frame has in the accumulated image.
_WEIGHT_OF_SHARE = 0.05


class Results(NamedTuple):
    """What a denoiser made of a frame, demodulated radiance ``(B, 3, H, W)``."""

    initial: Tensor
    final: Tensor


class Decided(NamedTuple):
    """Pixels that need no network, each ``(1, 1, H, W)`` bool.

    Args:
        passed: the accumulated image is the result.
        reused: the last result still holds.
    """

    passed: Tensor
    reused: Tensor


class Tiles:
    """The tiles of one still shot.

    Args:
        tolerance: see :class:`mcdenoise.plan.Plan`.
        alpha_min: smallest weight of the current frame in the accumulation.
    """

    def __init__(self, tolerance: float, alpha_min: float) -> None:
        self._tolerance, self._alpha_min = tolerance, alpha_min
        self.results: Results | None = None
        self._seen: tuple[Tensor, Tensor] | None = None
        self._marks: Tensor | None = None
        self._passed: Tensor | None = None
        self._reused: Tensor | None = None

    def decide(self, frame: Frame, color: Tensor, current: Tensor, length: Tensor) -> Decided:
        """Which tiles need no network in this frame.

        Args:
            frame: the frame.
            color: ``(B, 3, H, W)`` accumulated demodulated radiance.
            current: ``(B, 3, H, W)`` demodulated radiance of the frame alone.
            length: ``(B, 1, H, W)`` history length in frames.
        """
        share = 1 / length
        passed = self._converged(color, current, length)
        reused = torch.zeros_like(passed)
        if self._seen is not None and self.results is not None:
            reused = self._unchanged(frame, color, share, self._seen) & ~passed
        self._passed, self._reused = passed, reused
        size = color.shape[-2:]
        decided = Decided(_pixels(passed, size), _pixels(reused, size))
        if self._seen is None or not reused.any():
            self._seen = color, share
        else:
            self._seen = (
                torch.where(decided.reused, self._seen[0], color),
                torch.where(decided.reused, self._seen[1], share),
            )
        return decided

    def _converged(self, color: Tensor, current: Tensor, length: Tensor) -> Tensor:
        """Tiles whose estimated noise is below the tolerance.

        The residual ``c - a`` of a frame ``c`` and the accumulated ``a = alpha c + (1 - alpha) h`` has the variance
        ``(1 - alpha)^2 (1 + s') sigma^2``, with ``s'`` the sum of squared weights in ``h``; ``a`` has ``s sigma^2``.
        """
        color, current, length = (_thinned(image) for image in (color, current, length))
        alpha = (1 / length).clamp_min(self._alpha_min)
        factor = self._squared_weights(length) / ((1 - alpha).square() * (1 + self._squared_weights(length - 1)))
        factor = torch.where(length >= _LEAST_LENGTH, factor, torch.inf)
        variance = _means((current - color).square().mean(1, keepdim=True) * factor, TILE // _STRIDE)
        mean = _means(color.mean(1, keepdim=True), TILE // _STRIDE)
        residual = _means((current - color).square().mean(1, keepdim=True), TILE // _STRIDE).sqrt()
        # Where nothing differs, either there is no noise, or a renderer at rest repeats it: nothing can be told. What
        # is black so far may still be hit by light.
        noise = torch.where(residual > _LEAST_RESIDUAL * mean, variance.sqrt() / mean, torch.inf)
        stays = self._tolerance * _NOISE_HYSTERESIS
        limit = self._tolerance if self._passed is None else torch.where(self._passed, stays, self._tolerance)
        return (noise <= limit).all(0, keepdim=True)

    def _squared_weights(self, length: Tensor) -> Tensor:
        """Sum of the squared weights of the frames in an accumulated image: an average at first, a window later."""
        alpha, longest = self._alpha_min, 1 / self._alpha_min
        window = alpha / (2 - alpha)
        later = window + (alpha - window) * (1 - alpha) ** (2 * (length - longest).clamp_min(0))
        return torch.where(length <= longest, 1 / length.clamp_min(1), later)

    def _unchanged(self, frame: Frame, color: Tensor, share: Tensor, seen: tuple[Tensor, Tensor]) -> Tensor:
        """Tiles that, as far as a network sees, have changed by less than the tolerance since they were computed."""
        start = self._tolerance * _CHANGE_HYSTERESIS
        limit = start if self._reused is None else torch.where(self._reused, self._tolerance, start)
        thin = _change(_thinned(color), _thinned(share), _thinned(seen[0]), _thinned(seen[1]), TILE // _STRIDE)
        calm: Tensor = thin <= limit
        marks, self._marks = self._marks, None
        if not calm.any():
            return calm
        self._marks = _marks(frame)
        if marks is None or marks.shape != self._marks.shape:
            return torch.zeros_like(calm)
        same = (marks == self._marks).all(1, keepdim=True).all(0, keepdim=True)
        changed = ~(same & (_change(color, share, *seen, TILE) <= limit))
        return F.max_pool2d(changed.float(), 2 * _SEEN + 1, 1, _SEEN) == 0


def _change(color: Tensor, share: Tensor, old_color: Tensor, old_share: Tensor, tile: int) -> Tensor:
    """Of each tile, relative to its mean."""
    squares = _means((color - old_color).square().mean(1, keepdim=True), tile)
    change = torch.where(squares > 0, squares.sqrt() / _means(color.mean(1, keepdim=True), tile), 0)
    return (change + _WEIGHT_OF_SHARE * _means((share - old_share).abs(), tile)).amax(0, keepdim=True)


def _thinned(image: Tensor) -> Tensor:
    return image[..., ::_STRIDE, ::_STRIDE]


def _means(image: Tensor, tile: int) -> Tensor:
    return F.avg_pool2d(image, tile, ceil_mode=True, count_include_pad=False)


def _marks(frame: Frame) -> Tensor:
    """Means of the features over each tile, which tell one content from another."""
    features = [frame.albedo, frame.normal, frame.depth]
    images = [torch.where(image.isfinite(), image, 0) for image in features if image is not None]
    return _means(torch.cat(images, 1), TILE) if images else frame.color.new_zeros(1, 1, 1, 1)


def _pixels(tiles: Tensor, size: torch.Size) -> Tensor:
    wide = tiles.repeat_interleave(TILE, -2).repeat_interleave(TILE, -1)
    return wide[..., : size[0], : size[1]]
