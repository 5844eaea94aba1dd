"""The accumulated past of one shot: what is kept from frame to frame, and when it is thrown away."""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.buffers import Frame
from mcdenoise.ops import (
    NO_ALBEDO,
    Accumulate,
    ClampFireflies,
    HistoryLag,
    Surface,
    demodulate,
    motion_from_position,
)
from mcdenoise.ops._backend import Backend, choose_backend
from mcdenoise.ops._rows import by_rows
from mcdenoise.ops.temporal import Shorter, accumulate_numba

# A cut leaves a few accidental matches; a fast pan keeps far more than this share of the image.
_CUT_SHARE = 0.05
# What a mirror or glass shows does not move as its surface does: a long history would smear it.
_SPECULAR_LENGTH = 2
_STILL = 0.05  # pixels
_CUT = "cut"
_NO_WAY = "no motion, and no position with a previous camera"
# Of the shorter history that the long one is compared with: four frames have half the noise of one.
_RECENT_ALPHA = 0.25
# As many equally weighted frames have the noise of that history, once it is full: (2 - alpha) / alpha.
_RECENT_FRAMES = 7
# Light of more than this share, in the median block, is no firefly's; a shot whose light is caustics has another limit.
_LOST, CAUSTICS = 0.1, 120.0
# A light that is seen: how far the compressed radiance of 3x3 pixels may differ, how bright they are beside the mean of
# a window, and how far they may vary over the past. Fewer pixels are often alike by chance where one of a few lights is
# drawn for each, and some of the light is lost to that.
_EVEN, _BRIGHTER, _LIGHT_WINDOW, _STEADY = 0.03, 1.2, 9, 0.1
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


def _compressed(color: Tensor) -> Tensor:
    """What the test for lag compares means of: the fourth root of the radiance, in which a firefly hides little.

    Any power keeps the ratio of a difference to its noise at any exposure; a logarithm would need a unit.
    """
    return color.detach().mean(1, keepdim=True).clamp_min(0).sqrt().sqrt()


def _lag(lag: HistoryLag, history: Tensor, recent: Tensor, variance: Tensor) -> Tensor:
    """The test in half the resolution, for a quarter of the time: a window holds as many pixels, in blocks of four."""
    height, width = history.shape[-2:]
    halves = (
        F.avg_pool2d(image, 2, ceil_mode=True, count_include_pad=False) for image in (history, recent, variance / 4)
    )
    share: Tensor = lag(*halves).repeat_interleave(2, -2).repeat_interleave(2, -1)
    return share[..., :height, :width]


def _entering(clamp: ClampFireflies, color: Tensor, albedo: Tensor | None, compared: bool) -> Tensor:
    """Color without albedo and fireflies; for the test for lag also what that compares."""
    reach = clamp.kernel_size // 2
    if albedo is not None:
        color = by_rows(lambda *rows: clamp(demodulate(*rows)), color, albedo, reach=reach)
    else:
        color = by_rows(clamp, color, reach=reach)
    color = color.to(torch.promote_types(color.dtype, torch.float32))
    if not compared:
        return color
    mean = _compressed(color)
    return torch.cat([color, mean, mean.square()], 1)


def _entering_numba(clamp: ClampFireflies, color: Tensor, albedo: Tensor | None, compared: bool) -> Tensor:
    """As :func:`_entering`, in one pass."""
    from mcdenoise.ops._fast import history as fast

    entering: Tensor = fast.incoming(color, albedo, clamp.limit, clamp.kernel_size, compared)
    return entering


def _lights(root: Tensor) -> Tensor:
    """Where, by one frame, a light is seen: 1 in blocks of 3x3 pixels that are alike and brighter than what is around.

    Args:
        root: ``(B, 1, H, W)`` compressed radiance.
    """
    if min(root.shape[-2:]) < 3:
        return torch.zeros_like(root)
    largest, smallest = F.max_pool2d(root, 3, 1), -F.max_pool2d(-root, 3, 1)
    even = (largest - smallest <= _EVEN * largest).to(root.dtype)
    some = F.max_pool2d(F.pad(even, (2, 2, 2, 2)), 3, 1)
    around = F.avg_pool2d(root, _LIGHT_WINDOW, 1, _LIGHT_WINDOW // 2, count_include_pad=False)
    return some * (root > _BRIGHTER * around)


def _lights_numba(root: Tensor) -> Tensor:
    """As :func:`_lights`, in one pass."""
    from mcdenoise.ops._fast import history as fast

    found: Tensor = fast.lights(root, _EVEN, _BRIGHTER, _LIGHT_WINDOW)
    return found


def _takes_light(clamp: ClampFireflies, color: Tensor, albedo: Tensor | None) -> list[bool]:
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


class Snapshot(NamedTuple):
    """A history as it was between two frames."""

    state: _State | None
    clamps: list[ClampFireflies]


# The channels of a state.
_COLOR, _MEAN, _SQUARE, _RECENT, _RECENT_MEAN = slice(0, 3), slice(3, 4), slice(4, 5), slice(5, 9), slice(8, 9)


def _with_recent(entering: Tensor) -> Tensor:
    """All channels of a :class:`_State`."""
    return torch.cat([entering, entering[:, : _SQUARE.start]], 1) if entering.shape[1] > _SQUARE.start else entering


class _Past(NamedTuple):
    """A frame with its past: the first two of the next :class:`_State`, and why there is no more past, or ``""``."""

    color: Tensor
    length: Tensor
    reset: str

    def steady(self) -> Tensor:
        """Where the compressed radiance has hardly varied."""
        mean = self.color[:, _MEAN]
        return self.color[:, _SQUARE] - mean.square() <= (_STEADY * mean).square()


def _no_past(entering: Tensor, reset: str) -> _Past:
    return _Past(_with_recent(entering), torch.ones_like(entering[:, :1]), reset)


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

    What is kept of a frame are copies of its buffers, which may be written to as soon as it has been added.

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
        accumulate: Accumulate | None = None,
        fireflies: ClampFireflies | None = None,
        specular_length: float = _SPECULAR_LENGTH,
        anti_lag: HistoryLag | None = None,
    ) -> None:
        if not specular_length >= 0:
            raise ValueError(f"specular_length: expected at least 0, found {specular_length}")
        self.accumulate = Accumulate() if accumulate is None else accumulate
        self.fireflies = fireflies
        # Of each image of a shot, or one for all.
        self._clamps: list[ClampFireflies] = []
        self.specular_length = specular_length
        anti_lag = HistoryLag() if anti_lag is None else anti_lag
        self.anti_lag = None if math.isinf(anti_lag.threshold) else anti_lag
        self._state: _State | None = None

    def reset(self) -> None:
        """Forget the past: the next frame is the first of a shot."""
        self._state = None

    def snapshot(self) -> Snapshot:
        """What :meth:`restore` needs to take back the frames that are added from now on; no image is copied."""
        return Snapshot(self._state, self._clamps)

    def restore(self, snapshot: Snapshot) -> None:
        """Take back every frame that was added since."""
        self._state, self._clamps = snapshot

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
        before = () if state is None or not state.fits(frame.color) else (state.color, state.length)
        images = (frame.color, *(image for _, image in frame.items()), *before)
        backend = choose_backend(self.accumulate.backend, *images, differentiable=False, forms=("torch", "numba"))
        albedo = frame.albedo if demodulates else None
        if not before:
            self._clamps = self._chosen(frame.color, albedo)
        # What has no past and will be none is compared with nothing.
        compared = self.anti_lag is not None and (keeps or state is not None)
        entering = self._entering(frame.color, albedo, compared, backend)
        lights = None
        if compared:
            find = _lights_numba if backend == "numba" else partial(by_rows, _lights, reach=_LIGHT_WINDOW // 2)
            lights = find(entering[:, _MEAN])
        past = self._blend(frame, entering, lights, reprojects, backend)
        if past.reset == _CUT:
            # Another shot may be of another light, which is seen only now.
            before_cut, self._clamps = self._clamps, self._chosen(frame.color, albedo)
            if [clamp.limit for clamp in self._clamps] != [clamp.limit for clamp in before_cut]:
                entering = self._entering(frame.color, albedo, compared, backend)
                past = _no_past(entering, _CUT)
        self._state = None
        if keeps:
            label = None if lights is None else lights * past.steady()
            # Copies: a renderer may write the next frame into the same buffers.
            kept = (frame.position, frame.normal, frame.depth, frame.view_projection)
            position, normal, depth, matrix = (None if buffer is None else buffer.clone() for buffer in kept)
            color = past.color.clone() if past.color.data_ptr() == frame.color.data_ptr() else past.color
            self._state = _State(color, past.length, Surface(position, normal, depth, label), matrix)
        return Accumulated(past.color[:, _COLOR], entering[:, _COLOR], past.length, past.reset)

    def _chosen(self, color: Tensor, albedo: Tensor | None) -> list[ClampFireflies]:
        """How the fireflies of the shot are clamped that begins with this frame."""
        if self.fireflies is not None:
            return [self.fireflies]
        strict = ClampFireflies()
        caustics = _takes_light(strict, color, albedo)
        alike = len(set(caustics)) < 2
        return [ClampFireflies(CAUSTICS) if each else strict for each in ([any(caustics)] if alike else caustics)]

    def _entering(self, color: Tensor, albedo: Tensor | None, compared: bool, backend: Backend) -> Tensor:
        """The frame as it is accumulated: all channels of a :class:`_State` but the recent ones, which are the same."""
        entering = _entering_numba if backend == "numba" else _entering
        if len(self._clamps) == 1:
            return entering(self._clamps[0], color, albedo, compared)
        colors = color.split(1)
        albedos = [None] * len(colors) if albedo is None else albedo.split(1)
        return torch.cat([entering(*each, compared) for each in zip(self._clamps, colors, albedos, strict=True)])

    def _blend(
        self, frame: Frame, entering: Tensor, lights: Tensor | None, reprojects: bool, backend: Backend
    ) -> _Past:
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
        blend = self._blended_numba if backend == "numba" else self._blended
        blended = blend(frame, surface_before(frame)._replace(label=lights), entering, motion, state)
        return _no_past(entering, _CUT) if blended is None else _Past(*blended, "")

    def _blended(
        self, frame: Frame, surface: Surface, entering: Tensor, motion: Tensor | None, state: _State
    ) -> tuple[Tensor, Tensor] | None:
        """Color and length of the frame with its past, ``None`` at a cut."""
        color = _with_recent(entering)
        past, length = self.accumulate(color, state.color, state.length, motion, surface, state.surface)
        if int((length > 1).sum()) < _CUT_SHARE * length.numel():
            return None
        if frame.albedo is not None and motion is not None:
            both = by_rows(self._shortened, color, past, length, frame.albedo, motion)
            past, length = both[:, :-1], both[:, -1:]
        if self.anti_lag is not None:
            # Pairs of rows stay together.
            reach = 2 * (self.anti_lag.kernel_size // 2)
            both = by_rows(partial(self._without_lag, self.anti_lag), color, past, length, reach=reach)
            past, length = both[:, :-1], both[:, -1:]
        return past, length

    def _blended_numba(
        self, frame: Frame, surface: Surface, entering: Tensor, motion: Tensor | None, state: _State
    ) -> tuple[Tensor, Tensor] | None:
        """As :meth:`_blended`, with one pass over the images for all but the test for lag, which is in three."""
        from mcdenoise.ops._fast import history as fast

        rule = self.accumulate
        recent_alpha = max(rule.alpha_min, _RECENT_ALPHA)
        past, length, kept = accumulate_numba(
            *(entering, state.color, state.length, motion, surface, state.surface),
            *(rule.alpha_min, rule.rule, rule.position_limit, rule.normal_limit),
            Shorter(recent_alpha, frame.albedo, self.specular_length + 1, _STILL),
        )
        if int(kept.sum()) < _CUT_SHARE * length.numel():
            return None
        if self.anti_lag is not None:
            settings = (self.anti_lag.threshold, self.anti_lag.kernel_size, recent_alpha, _RECENT_FRAMES)
            fast.give_up_lag(past, length, entering, *settings)
        return past, length

    def _without_lag(self, lag: HistoryLag, color: Tensor, past: Tensor, length: Tensor) -> Tensor:
        """Color and length of what still holds: of the recent past by the frame, of the long one by the recent one."""
        mean, square = past[:, _MEAN], past[:, _SQUARE]
        counted = length.clamp_min(2)
        variance = (square - mean.square()).clamp_min(0) * (counted / (counted - 1))
        # Accumulated with the long one's share of the frame, which is the smaller one.
        alpha_min = max(self.accumulate.alpha_min, _RECENT_ALPHA)
        share = self._share_of_past(length, alpha_min) / self._share_of_past(length).clamp_min(1e-6)
        recent = torch.lerp(color[:, _RECENT], past[:, _RECENT], share)
        recent = torch.lerp(recent, color[:, _RECENT], _lag(lag, recent[:, 3:], color[:, _RECENT_MEAN], variance))
        share = _lag(lag, mean, recent[:, 3:], variance / length.clamp_max(_RECENT_FRAMES))
        shorter = torch.cat([recent, recent[:, 3:].square() + variance], 1)
        longer = torch.lerp(past[:, : _RECENT.start], shorter, share)
        return torch.cat([longer, recent, torch.lerp(length, length.clamp_max(1 / alpha_min), share)], 1)

    def _shortened(self, color: Tensor, accumulated: Tensor, length: Tensor, albedo: Tensor, motion: Tensor) -> Tensor:
        """Color and length if the past of mirrors and glass that move is no longer than ``specular_length``.

        Which pixels those are is known in this frame, the past's length in the previous one. So the past is shortened
        after it was blended in: ``lerp(color, past, p)`` with a smaller ``p`` lies on the way back to ``color``.
        """
        longest = self.specular_length + 1
        # A reduction over the channels takes a hundred times as long.
        moves = torch.hypot(motion[:, :1], motion[:, 1:]) > _STILL
        specular = albedo.amax(1, keepdim=True) < NO_ALBEDO
        too_long = moves & specular & (length > longest)
        share = self._share_of_past(length.clamp_max(longest)) / self._share_of_past(length).clamp_min(1e-6)
        shortened = torch.lerp(color, accumulated, share.to(color.dtype))
        return torch.cat([torch.where(too_long, shortened, accumulated), torch.where(too_long, longest, length)], 1)

    def _share_of_past(self, length: Tensor, alpha_min: float | None = None) -> Tensor:
        """The weight of the past in a result of history length ``length``, see :func:`mcdenoise.ops.accumulate`."""
        return 1 - (1 / length).clamp_min(self.accumulate.alpha_min if alpha_min is None else alpha_min)
