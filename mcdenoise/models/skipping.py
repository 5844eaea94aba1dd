"""A method that is not asked for what is known already: pixels without noise, and tiles in which nothing changes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.errors import InputError
from mcdenoise.frame import Frame, Skip
from mcdenoise.models._interface import Model, Output, State
from mcdenoise.models._journal import note, timed
from mcdenoise.models._noise_free import noise_free
from mcdenoise.models._wrapper import Wrapper
from mcdenoise.models.tiled import TILE

# So small that no metric moves in its third digit.
TOLERANCE = 1e-3
# One pixel in 16 says whether it is worth while to look at all of them.
_STRIDE = 4
# Tiles on each side that count for a network. Its lowest resolution sees twice as far, but what changes there moves a
# result by no more than what it does to the exposure of the whole image.
_SEEN = 4
# A tile may change by this fraction of the tolerance from frame to frame before it is reused, and in all by the
# tolerance.
_HYSTERESIS = 0.25
# How much a network's result changes, relatively, with the weight that a frame has in the accumulated image.
_EFFECT_OF_WEIGHT = 0.05


class Remembered(NamedTuple):
    """What is kept of a frame while nothing moves.

    Args:
        images: results by stage, ``"image"`` the last, ``(B, 3, H, W)``.
        color: ``(B, 3, H, W)`` radiance of which each tile was computed.
        weight: ``(B, 1, H, W)`` of the current frame in it: one over the history length.
        reused: ``(1, 1, h, w)`` bool, tiles that were reused.
        marks: means of the features over each tile, which tell one content from another; ``None`` until they are
            needed.
    """

    images: Mapping[str, Tensor]
    color: Tensor
    weight: Tensor
    reused: Tensor
    marks: Tensor | None


class Skipping(Wrapper):
    """Skips what a scene does not need of a method.

    Exactly: pixels without noise (:func:`mcdenoise.models._noise_free.noise_free`) are copied from the frame. Up to a
    tolerance, while nothing moves in the image (``frame.hints.still``): tiles of 32x32 pixels that have changed by less
    since they were last computed, and four tiles around them too, are not computed again. A tile is reused only when it
    changes by less than a quarter of the tolerance from frame to frame, so that it does not switch to and fro.

    Args:
        inner: a method; where it is :class:`mcdenoise.models.Tiled`, or a chain of such, it computes no more than the
            tiles that are left.
        tolerance: largest change, relative to the tile's mean, of a tile that is not computed again; 0 computes every
            tile that has noise.

    Raises:
        InputError: the tolerance is negative or not finite.
    """

    def __init__(self, inner: Model, tolerance: float = TOLERANCE) -> None:
        super().__init__(inner)
        if not 0 <= tolerance < math.inf:
            raise InputError(f"tolerance: expected a finite number of at least 0, found {tolerance:g}")
        self.tolerance = tolerance

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        before, inner = (None, None) if state is None else state
        current = frame.color if frame.current is None else frame.current
        still = frame.hints.still and self.tolerance > 0 and not frame.hints.keep_all
        with timed("plan", current.device):
            free = noise_free(frame)
            _note("noise-free pixels", free, "background and emitters are copied", exact=True)
            kept = self._unchanged(frame, before) if still else None
            reused = None if kept is None or before is None else _pixels(kept.reused, frame.size)
            _note("unchanged tiles", reused, f"change below {self.tolerance:g}", exact=False)
            skip = _skip(free, reused, current, {} if before is None else before.images)
        with timed("network", current.device):
            output, inner = self.inner(frame.replace(skip=skip), inner)
            if skip is not None:
                image = torch.where(skip.mask, skip.images["image"].to(output.image.dtype), output.image)
                output = output._replace(image=image)
        if kept is not None:
            kept = kept._replace(images={**output.stages, "image": output.image})
        return output, None if kept is None and inner is None else (kept, inner)

    def _unchanged(self, frame: Frame, before: Remembered | None) -> Remembered:
        """Which tiles, as far as a network sees, have changed by less than the tolerance since they were computed."""
        weight = torch.ones_like(frame.color[:, :1]) if frame.length is None else 1 / frame.length
        if before is None:
            sides = (-(-side // TILE) for side in frame.size)
            nothing = torch.zeros((1, 1, *sides), dtype=torch.bool, device=weight.device)
            return Remembered({}, frame.color, weight, nothing, None)
        limit = torch.where(before.reused, self.tolerance, self.tolerance * _HYSTERESIS)
        thin = (_thinned(image) for image in (frame.color, weight, before.color, before.weight))
        calm = _change(*thin, TILE // _STRIDE) <= limit
        if not calm.any():
            return Remembered({}, frame.color, weight, calm, None)
        marks = _marks(frame)
        if before.marks is None:
            return Remembered({}, frame.color, weight, torch.zeros_like(calm), marks)
        same = (marks == before.marks).all(1, keepdim=True).all(0, keepdim=True)
        changed = ~(same & (_change(frame.color, weight, before.color, before.weight, TILE) <= limit))
        reused = F.max_pool2d(changed.float(), 2 * _SEEN + 1, 1, _SEEN) == 0
        pixels = _pixels(reused, frame.size)
        color, weight = torch.where(pixels, before.color, frame.color), torch.where(pixels, before.weight, weight)
        return Remembered({}, color, weight, reused, marks)


def _skip(
    free: Tensor | None, reused: Tensor | None, current: Tensor, images: Mapping[str, Tensor]
) -> Skip | None:
    """Pixels whose result is known, and that result at every stage."""
    if reused is not None and (torch.compiler.is_compiling() or reused.any()):
        mask = reused.expand_as(current[:, :1])
        if free is None:
            return Skip(mask, images)
        return Skip(mask | free, {name: torch.where(free, current, image) for name, image in images.items()})
    # Whatever stages there are: a noise-free pixel is the same in all of them.
    return None if free is None else Skip(free, _Everywhere(current))


class _Everywhere(dict[str, Tensor]):
    """The same image for every stage."""

    def __init__(self, image: Tensor) -> None:
        super().__init__(image=image)

    def __missing__(self, name: str) -> Tensor:
        return self["image"]

    def get(self, name: str, default: object = None) -> Tensor:  # type: ignore[override]
        return self[name]


def _note(name: str, pixels: Tensor | None, reason: str, *, exact: bool) -> None:
    if torch.compiler.is_compiling():
        return
    fraction = 0.0 if pixels is None else int(pixels.count_nonzero()) / pixels.numel()
    note(name, reason if fraction else "there are none", fraction, exact=exact)


def _change(color: Tensor, weight: Tensor, old_color: Tensor, old_weight: Tensor, tile: int) -> Tensor:
    """Of each tile, relative to its mean."""
    squares = _means((color - old_color).square().mean(1, keepdim=True), tile)
    change = torch.where(squares > 0, squares.sqrt() / _means(color.mean(1, keepdim=True), tile), 0)
    return (change + _EFFECT_OF_WEIGHT * _means((weight - old_weight).abs(), tile)).amax(0, keepdim=True)


def _thinned(image: Tensor) -> Tensor:
    return image[..., ::_STRIDE, ::_STRIDE]


def _means(image: Tensor, tile: int) -> Tensor:
    return F.avg_pool2d(image, tile, ceil_mode=True, count_include_pad=False)


def _marks(frame: Frame) -> Tensor:
    features = [frame.albedo, frame.normal, frame.depth]
    images = [torch.where(image.isfinite(), image, 0) for image in features if image is not None]
    return _means(torch.cat(images, 1), TILE) if images else frame.color.new_zeros(1, 1, 1, 1)


def _pixels(tiles: Tensor, size: tuple[int, int]) -> Tensor:
    wide = tiles.repeat_interleave(TILE, -2).repeat_interleave(TILE, -1)
    return wide[..., : size[0], : size[1]]
