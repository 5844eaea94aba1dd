"""The accumulated past of one shot: what is kept from frame to frame, and when it is thrown away."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.buffers import Frame
from mcdenoise.ops import (
    Accumulate,
    ClampFireflies,
    HistoryLag,
    Surface,
    demodulate,
    motion_from_position,
)
from mcdenoise.ops._steps.history import COLOR, MEAN, SQUARE, blend, incoming, lights, without_history
from mcdenoise.ops.lag import KERNEL_SIZE

# A cut leaves a few accidental matches; a fast pan keeps far more than this share of the image.
_CUT_SHARE = 0.05
# What a mirror or glass shows does not move as its surface does: a long history would smear it.
_SPECULAR_LENGTH = 2
_CUT = "cut"
_NO_WAY = "no motion, and no position with a previous camera"
# Light of more than this share, in the median block, is no firefly's; a shot whose light is caustics has another limit.
_LOST, CAUSTICS = 0.1, 120.0
# How far the compressed radiance of a light that is seen may vary over the past.
_STEADY = 0.1
# Side of a block in pixels; rows of blocks that are looked at; and how few blocks say nothing.
_BLOCK, _STRIPS, _LEAST_BLOCKS = 32, 16, 16


def surface_before(frame: Frame) -> Surface:
    """What a frame shows, at the positions that it had in the frame before; its normals and depths are the current."""
    before = frame.position if frame.previous_position is None else frame.previous_position
    return Surface(before, frame.normal, frame.depth)


def motion_to_previous(frame: Frame, previous_view_projection: Tensor | None) -> Tensor | None:
    """Where each pixel's surface point was in the frame before, relative to where it is now.

    Args:
        frame: the current frame.
        previous_view_projection: ``(B, 4, 4)`` of the frame before; needed where the frame has no motion of its own.

    Returns:
        ``(B, 2, H, W)`` pixels: the frame's own motion, else that of its previous positions (its positions, where it
        has none) seen from the previous camera; ``None`` where it has neither.
    """
    if frame.motion is not None:
        return frame.motion
    position = surface_before(frame).position
    if position is None or previous_view_projection is None:
        return None
    return motion_from_position(position, previous_view_projection)


def _thinned(image: Tensor) -> Tensor:
    """One pixel in 64: enough to see most of what moves."""
    return image[..., ::8, ::8]


def _takes_light(clamp: Any, color: Tensor, albedo: Tensor | None) -> list[bool]:
    """Of each image, whether most of it would lose much of its light; not told of images of a few lit blocks."""
    rows = -(-color.shape[-2] // _BLOCK)
    shares = []
    for top in range(0, color.shape[-2], _BLOCK * -(-rows // _STRIPS)):
        light = color[..., top : top + _BLOCK, :]
        if albedo is not None:
            light = demodulate(light, albedo[..., top : top + _BLOCK, :])
        light = light.to(torch.promote_types(light.dtype, torch.float32))
        before, after = (
            F.avg_pool2d(image.mean(1, keepdim=True), _BLOCK, ceil_mode=True, count_include_pad=False)
            for image in (light, clamp(light))
        )
        # Not a number where there is no light to lose.
        shares.append((1 - after / before).flatten(1))
    lost = torch.cat(shares, 1)
    enough = (~lost.isnan()).sum(1) >= _LEAST_BLOCKS
    found: list[bool] = (enough & (lost.nanmedian(1).values > _LOST)).tolist()
    return found


def _equal(a: Tensor | None, b: Tensor | None) -> bool:
    if a is None or b is None or a.device != b.device:
        return False
    return a is b or (torch.equal(_thinned(a), _thinned(b)) and torch.equal(a, b))


class Accumulated(NamedTuple):
    """One frame after accumulation.

    Args:
        color: ``(B, 3, H, W)`` accumulated demodulated radiance.
        current: ``(B, 3, H, W)`` demodulated radiance of this frame alone, without fireflies.
        length: ``(B, 1, H, W)`` history length in frames, 1 where there is none.
        reset: why the past was thrown away, or ``""`` where it was used.
    """

    color: Tensor
    current: Tensor
    length: Tensor
    reset: str


class _State(NamedTuple):
    """The past of a shot.

    Args:
        color: ``(B, 3, H, W)``; where lag is looked for ``(B, 9, H, W)``: also the means of compressed radiance and of
            its square, and of a shorter past color and compressed radiance.
        length: of the longer past.
        surface: what was seen.
        view_projection: by which camera.
    """

    color: Tensor
    length: Tensor
    surface: Surface
    view_projection: Tensor | None

    def fits(self, color: Tensor) -> bool:
        """Whether it can be the past of this image."""
        return self.length.shape == color[:, :1].shape and self.length.device == color.device


class _Past(NamedTuple):
    """A frame with its past: the first two of the next :class:`_State`, and why there is no more past, or ``""``."""

    color: Tensor
    length: Tensor
    reset: str

    def steady(self) -> Tensor:
        """Where the compressed radiance has hardly varied."""
        mean = self.color[:, MEAN]
        return self.color[:, SQUARE] - mean.square() <= (_STEADY * mean).square()


def _no_past(entering: Tensor, reset: str) -> _Past:
    return _Past(without_history(entering), torch.ones_like(entering[:, :1]), reset)


class History:
    """Demodulates frames and accumulates them, one after the other.

    The motion is the frame's own where it has one, else that of its previous positions (its positions, where it has
    none) seen from the previous camera; with neither there is no past. Where positions and cameras say that nothing
    moved, the motion is zero, not the rounding of a projection, which would blur a still image a little more with every
    frame. The consistency test compares the previous frame's positions with the previous positions too, so that what
    moves keeps its past. It compares the normals as they are: what turns by more than the normal limit from one frame
    to the next starts anew.

    Before it is accumulated, a frame loses its fireflies. Where most of the image would lose more than a tenth of its
    light to that (the median block of 32x32 pixels of the first frame of a shot; of each image of a batch by itself),
    these are no fireflies but caustics, and only what is 120 times as bright as its lit neighbours is clamped. Where
    nothing diffuse is seen (no albedo in any channel: mirrors, glass) and the image moves by more than 0.05 pixels, the
    past counts for no more than 2 frames, since reflections do not move with the surface. Emitters and background have
    no albedo either and are treated alike; they have little noise to lose. A frame without an albedo buffer says
    nothing of mirrors, and its past is kept.

    Where a light is switched or moves, or a reflection moves over a glossy surface, the past is wrong although every
    surface is still there, and would fade in some 40 frames. It is given up where local means say so
    (:func:`mcdenoise.ops.history_lag`), in two steps: a second history of about four frames is compared with the
    current frame, and the long one with that. Compared are means of the fourth root of the radiance (channel mean,
    demodulated, without fireflies); their noise is what the same root varied by over the past. The decision has no
    derivative.

    A lamp in the plane of a ceiling, with its albedo, is the same surface by all tests, and bilinear taps would carry
    its light over its edge, a little further with every frame. So pixels that see a light take their past from pixels
    that saw one, and all others from the others, where both are among the taps. A light is seen in blocks of 3x3 pixels
    whose compressed radiance differs by less than 3 % and is 1.2 times the mean of a 9x9 window or more (twice, in
    radiance); it was seen where that is so and the compressed radiance varied by less than a tenth over the past. A
    light that is narrower than three pixels bleeds still. Without the test for lag this is not looked for either.

    Half-precision frames are accumulated in float32, which holds 10,000 frames as well as ten.

    The past is thrown away by :meth:`reset`, when the image size changes, and at a cut (less than 5 % of the pixels
    find their surface in the previous frame).

    Args:
        accumulate: the rule and its limits; by default those that scale with depth. The published BMFR rule is
            ``Accumulate(0.2, "bmfr", position_limit, normal_limit)`` with the scene's squared limits.
        fireflies: how fireflies are clamped, in every shot; ``ClampFireflies(math.inf)`` leaves them. By default as
            above.
        specular_length: the longest history of what is seen in mirrors and through glass while the image moves, in
            frames, at least 0; infinity treats them as everything else.
        anti_lag: the test for changes of light, in half the resolution; ``HistoryLag(math.inf)`` makes none, in two
            thirds of the time.

    Raises:
        ValueError: ``specular_length`` is negative.
    """

    def __init__(
        self,
        accumulate: Any = None,
        fireflies: Any = None,
        specular_length: float = _SPECULAR_LENGTH,
        anti_lag: Any = None,
    ) -> None:
        if not specular_length >= 0:
            raise ValueError(f"specular_length: expected at least 0, found {specular_length}")
        self.accumulate: Any = Accumulate() if accumulate is None else accumulate
        self.fireflies = fireflies
        # Of each image of a shot, or one for all.
        self._clamps: list[Any] = []
        self.specular_length = specular_length
        anti_lag = HistoryLag() if anti_lag is None else anti_lag
        self.anti_lag = None if math.isinf(anti_lag.threshold) else anti_lag
        self._state: _State | None = None

    def reset(self) -> None:
        """Forget the past: the next frame is the first of a shot."""
        self._state = None

    def is_still(self, frame: Frame) -> bool:
        """Whether every pixel of the next frame shows what it showed in the frame before, as far as a frame tells.

        Args:
            frame: the next frame; true where its motion is zero everywhere, or else where the camera is the same and no
                position differs from its previous position.
        """
        if self._state is None:
            return False
        if frame.motion is not None:
            return not (_thinned(frame.motion).any() or frame.motion.any())
        cameras = (self._state.view_projection, frame.view_projection)
        if frame.position is None or not _equal(*cameras):
            return False
        return frame.previous_position is None or _equal(frame.position, frame.previous_position)

    def update(
        self, frame: Frame, *, demodulates: bool = True, reprojects: bool = True, keeps: bool = True
    ) -> Accumulated:
        """Add a frame.

        Args:
            frame: the next frame; its values must be valid (:meth:`mcdenoise.buffers.Frame.validate`).
            demodulates: divide by the albedo; not needed where :func:`mcdenoise.ops.demodulate` would divide by one.
            reprojects: look for each pixel's past where it was; not needed for a frame that :meth:`is_still`.
            keeps: remember the frame; not needed for the last one.
        """
        frame, state = frame.with_depth(), self._state
        albedo = frame.albedo if demodulates else None
        if state is None or not state.fits(frame.color):
            self._clamps = self._chosen(frame.color, albedo)
        # What has no past and will be none is compared with nothing.
        compared = self.anti_lag is not None and (keeps or state is not None)
        entering = self._entering(frame.color, albedo, compared)
        seen = lights(entering[:, MEAN]) if compared else None
        past = self._blend(frame, entering, seen, reprojects)
        if past.reset == _CUT:
            # Another shot may be of another light, which is seen only now.
            before_cut, self._clamps = self._clamps, self._chosen(frame.color, albedo)
            if [clamp.limit for clamp in self._clamps] != [clamp.limit for clamp in before_cut]:
                entering = self._entering(frame.color, albedo, compared)
                past = _no_past(entering, _CUT)
        self._state = None
        if keeps:
            label = None if seen is None else seen * past.steady()
            surface = Surface(frame.position, frame.normal, frame.depth, label)
            self._state = _State(past.color, past.length, surface, frame.view_projection)
        return Accumulated(past.color[:, COLOR], entering[:, COLOR], past.length, past.reset)

    def _chosen(self, color: Tensor, albedo: Tensor | None) -> list[Any]:
        """How the fireflies of the shot are clamped that begins with this frame."""
        if self.fireflies is not None:
            return [self.fireflies]
        strict = ClampFireflies()
        caustics = _takes_light(strict, color, albedo)
        alike = len(set(caustics)) < 2
        return [ClampFireflies(CAUSTICS) if each else strict for each in ([any(caustics)] if alike else caustics)]

    def _entering(self, color: Tensor, albedo: Tensor | None, compared: bool) -> Tensor:
        """The frame as it is accumulated: all channels of a :class:`_State` but the recent ones, which are the same."""
        limits = [clamp.limit for clamp in self._clamps]
        limit = limits[0] if len(limits) == 1 else torch.tensor(limits, device=color.device).reshape(-1, 1, 1, 1)
        window = self._clamps[0].kernel_size
        return incoming(color, albedo, limit, window, compared=compared)

    def _blend(self, frame: Frame, entering: Tensor, seen: Tensor | None, reprojects: bool) -> _Past:
        """The frame with its past."""
        state = self._state
        if state is None:
            lost = frame.motion is None and (frame.position is None or frame.view_projection is None)
            return _no_past(entering, _NO_WAY if lost else "first frame")
        if not state.fits(entering):
            return _no_past(entering, "size change")
        motion = None
        if reprojects and (frame.motion is not None or not self.is_still(frame)):
            motion = motion_to_previous(frame, state.view_projection)
            if motion is None:
                return _no_past(entering, _NO_WAY)
        rule, lag = self.accumulate, self.anti_lag
        color, length, kept = blend(
            *(entering, state.color, state.length, motion),
            *(surface_before(frame)._replace(label=seen), state.surface),
            alpha_min=rule.alpha_min,
            rule=rule.rule,
            position_limit=rule.position_limit,
            normal_limit=rule.normal_limit,
            albedo=frame.albedo,
            specular_length=self.specular_length,
            lag_threshold=math.inf if lag is None else lag.threshold,
            lag_kernel_size=KERNEL_SIZE if lag is None else lag.kernel_size,
        )
        return _no_past(entering, _CUT) if float(kept.mean()) < _CUT_SHARE else _Past(color, length, "")
