"""A wrapper that skips a method where its result is known: pixels without noise, and tiles that do not change."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.errors import InputError
from mcdenoise.frame import Frame, Skip
from mcdenoise.models._interface import Model, Note, Output, State
from mcdenoise.models._layers import alpha_of, completed
from mcdenoise.models._noise_free import noise_free
from mcdenoise.models._state import own_pair, own_state
from mcdenoise.models._wrapper import Wrapper
from mcdenoise.models.tiled import TILE
from mcdenoise.ops._window import block_means, of_blocks

# So small that no error metric changes in its third digit.
TOLERANCE = 1e-3
# Distance of the pixels that are tested first: all pixels are tested only if this subset suggests it.
_STRIDE = 4
# Margin in tiles around a changed one. A network's coarsest level sees twice as far, but a change there affects the
# result no more than through the exposure of the whole image.
_SEEN = 4
# Hysteresis: a tile that is passed through is computed again only when its noise exceeds the threshold by this factor.
_NOISE_HYSTERESIS = 2.0
# If frame and accumulated image differ by less than this, relatively, the difference does not measure the noise.
_LEAST_RESIDUAL = 1e-4
# Smallest history length for estimating the noise.
_LEAST_LENGTH = 8
# A tile is reused if it changes by less than this fraction of the tolerance per frame, and by less than the tolerance
# in total.
_HYSTERESIS = 0.25
# Relative change of a network's result with the weight of the current frame in the accumulated image.
_EFFECT_OF_WEIGHT = 0.05


class Remembered(NamedTuple):
    """State while nothing moves.

    Args:
        image: ``(B, 3, H, W)`` the result; ``None`` until it is computed.
        color: ``(B, 3, H, W)`` radiance from which each tile was computed.
        weight: ``(B, 1, H, W)`` weight of the current frame in it: one over the history length.
        passed: ``(B, 1, h, w)`` bool, tiles whose accumulated image was passed through; equal for all images of a
            batch.
        reused: ``(B, 1, h, w)`` bool, tiles whose last result was reused; equal for all images of a batch.
        marks: means of the features over each tile, which identify its content; ``None`` until they are needed.
    """

    image: Tensor | None
    color: Tensor
    weight: Tensor
    passed: Tensor
    reused: Tensor
    marks: Tensor | None


class Skipping(Wrapper):
    """Skips the parts of a method's work that a scene does not need.

    Exactly: pixels without noise (:func:`mcdenoise.models._noise_free.noise_free`) are copied from the frame. Up to a
    tolerance, while nothing moves in the image (``frame.hints.still``): tiles of 32x32 pixels whose accumulated noise
    is below the tolerance are passed through; and tiles are reused if they and all tiles up to four tiles away have
    changed by less than the tolerance since they were last computed. Both have hysteresis: a tile that is passed
    through is computed again only at twice the noise, and a tile is reused only if it changes by less than a quarter of
    the tolerance per frame. Neither is done if layers or an alpha are requested, because their proportions change where
    the color does not.

    Args:
        inner: a method. :class:`mcdenoise.models.Tiled`, also as the last one of a chain, computes only the remaining
            tiles.
        tolerance: largest noise (root mean square, relative to the tile's mean) of a tile that is passed through, and
            largest relative change of a tile that is reused; 0 computes every tile that has noise.
        alpha_min: setting of the accumulation, for estimating its noise, see :class:`mcdenoise.models.Accumulated`.

    Raises:
        InputError: the tolerance is negative or not finite.
    """

    stage = "plan"

    def __init__(self, inner: Model, tolerance: float = TOLERANCE, alpha_min: float = 0.1) -> None:
        super().__init__(inner)
        if not 0 <= tolerance < math.inf:
            raise InputError(f"tolerance: expected a finite number of at least 0, found {tolerance:g}")
        self.tolerance, self._alpha_min = tolerance, alpha_min

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        remembered, inner = own_pair(state, "skipping")
        before = own_state(remembered, Remembered, frame)
        current = frame.color if frame.current is None else frame.current
        still = frame.hints.still and self.tolerance > 0 and not frame.hints.keep_all
        # The color of a tile may have converged while light still moves between its layers.
        carries = bool(frame.layers) or alpha_of(frame) is not None
        free = noise_free(frame)
        kept = self._decided(frame, current, before) if still and not carries else None
        passed = None if kept is None else of_blocks(kept.passed, TILE, *frame.size)
        reused = None if kept is None else of_blocks(kept.reused, TILE, *frame.size)
        none = "layers or alpha are asked for" if still and carries else "there are none"
        result = None if before is None else before.image
        skip = _skip(free, passed, reused, current, frame.color, result)
        output, inner = self.inner(frame.replace(skip=skip), inner)
        if skip is not None:
            image = torch.where(skip.mask, skip.image.to(output.image.dtype), output.image)
            output = completed(frame, output._replace(image=image))
        output = output.noted(
            _note("noise-free pixels", free, "background and emitters are copied", exact=True),
            _note("converged tiles", passed, f"noise below {self.tolerance:g}", none, exact=False),
            _note("unchanged tiles", reused, f"change below {self.tolerance:g}", none, exact=False),
        )
        if frame.hints.last:
            kept = None
        elif kept is not None:
            kept = kept._replace(image=output.image)
        return output, None if kept is None and inner is None else (kept, inner)

    def _decided(self, frame: Frame, current: Tensor, before: Remembered | None) -> Remembered:
        """The state after this frame, without its image: it holds the tiles that are not computed."""
        length = torch.ones_like(frame.color[:, :1]) if frame.length is None else frame.length
        passed = self._converged(frame.color, current, length, None if before is None else before.passed)
        weight = 1 / length
        if before is None:
            return Remembered(None, frame.color, weight, passed, torch.zeros_like(passed), None)
        reused, marks = self._unchanged(frame, weight, before)
        reused = reused & ~passed
        pixels = of_blocks(reused, TILE, *frame.size)
        color, weight = torch.where(pixels, before.color, frame.color), torch.where(pixels, before.weight, weight)
        return Remembered(None, color, weight, passed, reused, marks)

    def _converged(self, color: Tensor, current: Tensor, length: Tensor, before: Tensor | None) -> Tensor:
        """Tiles whose estimated noise is below the tolerance.

        The residual ``c - a`` of a frame ``c`` and the accumulated ``a = alpha c + (1 - alpha) h`` has the variance
        ``(1 - alpha)^2 (1 + s') sigma^2``, with ``s'`` the sum of squared weights in ``h``; ``a`` has ``s sigma^2``.
        """
        color, current, length = (_thinned(image) for image in (color, current, length))
        alpha = (1 / length).clamp_min(self._alpha_min)
        factor = self._squared_weights(length) / ((1 - alpha).square() * (1 + self._squared_weights(length - 1)))
        factor = torch.where(length >= _LEAST_LENGTH, factor, torch.inf)
        squares = (current - color).square().mean(1, keepdim=True)
        variance, residual = (block_means(image, TILE // _STRIDE) for image in (squares * factor, squares))
        mean = block_means(color.mean(1, keepdim=True), TILE // _STRIDE)
        # If the difference is zero, the pixel has no noise, or the renderer repeats its image: the noise is unknown. A
        # black pixel may still receive light later.
        noise = torch.where(residual.sqrt() > _LEAST_RESIDUAL * mean, variance.sqrt() / mean, torch.inf)
        stays = self.tolerance * _NOISE_HYSTERESIS
        limit = self.tolerance if before is None else torch.where(before, stays, self.tolerance)
        return (noise <= limit).all(0, keepdim=True).expand_as(noise)

    def _squared_weights(self, length: Tensor) -> Tensor:
        """Sum of the squared weights of the accumulated frames: first an average, later an exponential window."""
        alpha, longest = self._alpha_min, 1 / self._alpha_min
        window = alpha / (2 - alpha)
        later = window + (alpha - window) * (1 - alpha) ** (2 * (length - longest).clamp_min(0))
        return torch.where(length <= longest, 1 / length.clamp_min(1), later)

    def _unchanged(self, frame: Frame, weight: Tensor, before: Remembered) -> tuple[Tensor, Tensor | None]:
        """Tiles whose input has changed by less than the tolerance since they were computed.

        Returns:
            The tiles, and the marks of this frame if they were computed.
        """
        limit = torch.where(before.reused, self.tolerance, self.tolerance * _HYSTERESIS)
        now, then = (tuple(map(_thinned, pair)) for pair in ((frame.color, weight), (before.color, before.weight)))
        calm = _change(now[0], now[1], then[0], then[1], TILE // _STRIDE) <= limit
        if not calm.any():
            return calm, None
        marks = _marks(frame)
        # They differ in shape where the frame before had other features.
        if before.marks is None or marks.shape != before.marks.shape:
            return torch.zeros_like(calm), marks
        same = (marks == before.marks).all(1, keepdim=True).all(0, keepdim=True)
        changed = ~(same & (_change(frame.color, weight, before.color, before.weight, TILE) <= limit))
        return F.max_pool2d(changed.float(), 2 * _SEEN + 1, 1, _SEEN) == 0, marks


def _skip(
    free: Tensor | None,
    passed: Tensor | None,
    reused: Tensor | None,
    current: Tensor,
    color: Tensor,
    result: Tensor | None,
) -> Skip | None:
    """Pixels with a known result, and that result: the previous one, the accumulated radiance, or the frame's color."""
    if passed is None or reused is None or not (passed.any() or reused.any()):
        return None if free is None else Skip(free, current)
    known = color if result is None else torch.where(passed, color, result)
    mask = (passed | reused).expand_as(current[:, :1])
    return Skip(mask, known) if free is None else Skip(mask | free, torch.where(free, current, known))


def _note(name: str, pixels: Tensor | None, reason: str, none: str = "there are none", *, exact: bool) -> Note:
    if pixels is None:
        return Note(name, none, exact=exact)
    return Note(name, reason, pixels.count_nonzero() / pixels.numel(), otherwise=none, exact=exact)


def _change(color: Tensor, weight: Tensor, old_color: Tensor, old_weight: Tensor, tile: int) -> Tensor:
    """Change of each tile, relative to its mean."""
    squares = block_means((color - old_color).square().mean(1, keepdim=True), tile)
    change = torch.where(squares > 0, squares.sqrt() / block_means(color.mean(1, keepdim=True), tile), 0)
    return (change + _EFFECT_OF_WEIGHT * block_means((weight - old_weight).abs(), tile)).amax(0, keepdim=True)


def _thinned(image: Tensor) -> Tensor:
    return image[..., ::_STRIDE, ::_STRIDE]


def _marks(frame: Frame) -> Tensor:
    features = [frame.albedo, frame.normal, frame.depth]
    images = [torch.where(image.isfinite(), image, 0) for image in features if image is not None]
    return block_means(torch.cat(images, 1), TILE) if images else torch.zeros_like(frame.color[:, :1, :1, :1])
