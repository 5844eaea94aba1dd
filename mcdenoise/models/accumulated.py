"""A method on accumulated radiance: the history of a shot, its state from frame to frame, and when it ends."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from mcdenoise.errors import InputError
from mcdenoise.frame import MOTION, RADIANCE, Frame, tells_motion
from mcdenoise.models._fireflies import believed, light_of, light_of_fireflies, with_light
from mcdenoise.models._history import NO_MOTION, comparable, motion_unless_still, reset_of, surface_before
from mcdenoise.models._interface import GUIDES, Model, Note, Output, State, at_hand
from mcdenoise.models._layers import alpha_of, completed
from mcdenoise.models._state import ADVICE, own_pair, own_state
from mcdenoise.models._wrapper import Wrapper
from mcdenoise.ops import Surface
from mcdenoise.ops._history import COLOR, MEAN, RECENT, RECENT_MEAN, SQUARE
from mcdenoise.ops._steps.history import blend, incoming, lights, without_history
from mcdenoise.ops.fireflies import LIMIT
from mcdenoise.ops.lag import THRESHOLD

# A cut leaves a few accidental matches; a fast pan keeps far more than this fraction of the image.
CUT_FRACTION = 0.05
# Longest history of mirrors and glass: an image in them does not move with their surface, and would be smeared.
SPECULAR_LENGTH = 2.0
# Where clamping would take more than this fraction of the light of the median block, the shot's light is caustics,
# which have another limit.
_LOST, _CAUSTICS = 0.1, 120.0
# A light is steady if its compressed radiance varied by less than this fraction over the history.
_STEADY = 0.1

_Carried: TypeAlias = tuple[Tensor | None, ...]


class History(NamedTuple):
    """The history of a shot.

    A history of zeros only is that of no frame, so that an exported graph can begin with it. A history depends on the
    radiance alone: methods that accumulate by the same settings may exchange theirs.

    Args:
        color: ``(B, 3, H, W)``; where lag is looked for ``(B, 9, H, W)``, see
            :func:`mcdenoise.ops._steps.history.blend`.
        length: ``(B, 1, H, W)`` in frames.
        surface: the surfaces that the last frame shows.
        view_projection: ``(B, 4, 4)`` camera of the last frame.
        limit: ``(B, 1, 1, 1)`` limit of fireflies in this shot, see :func:`mcdenoise.ops.clamp_fireflies`.
        carried: for each layer, then for the alpha, then for each buffer of ``also``, the channels of ``color`` that
            are no compressed radiance; ``None`` for a buffer that the frame lacked.
        light: ``(B, 1, H, W)`` how much light lasts, see :func:`mcdenoise.models._fireflies.believed`; ``None`` where
            no fireflies are clamped.
    """

    color: Tensor
    length: Tensor
    surface: Surface
    view_projection: Tensor | None
    limit: Tensor
    carried: _Carried = ()
    light: Tensor | None = None


class _Blended(NamedTuple):
    """A frame with its history.

    Args:
        history: with this frame, without the light that lasts; its limit is 0 where that is chosen anew.
        entering: see :func:`mcdenoise.ops._steps.history.incoming`.
        limit: limit of the fireflies of this frame.
        motion: to the frame before; ``None`` if nothing moves.
        still: whether that is so.
        reset: why there is no history; empty if there is one.
        found: fraction of the pixels that have a history.
        cut: ``(B, 1, 1, 1)`` whether there is a cut; ``None`` if it is known that all images have one, or none has.
    """

    history: History
    entering: Tensor
    limit: Tensor
    motion: Tensor | None
    still: bool | Tensor
    reset: str
    found: Tensor | None = None
    cut: Tensor | None = None

    @property
    def note(self) -> Note:
        """What the report says about the history."""
        if self.cut is None:
            return Note("history", self.reset, value=self.found)
        return Note("history", "cut", self.cut.all().float(), self.found, otherwise="")


class Accumulated(Wrapper):
    """Blends each frame with the reprojected history of its shot, and passes the result to a method.

    The method sees the accumulated radiance as ``color``, that of the frame alone as ``current``, and the ``length`` of
    the history; where lag is looked for, the radiance of about the last four frames as ``recent``; whether nothing
    moves, as ``hints.still``; and no state at the beginning of a shot, or zeros for the images of a batch that begin
    one. A shot ends at a cut (less than 5 % of the pixels find their surface in the previous frame), when the image's
    size changes, where a frame has no motion, and where a buffer of ``also`` is in only one of two successive frames.
    The accumulated image is the stage ``accumulated``.

    Motion is the frame's own where it has one, else that of its previous positions (its positions, where it has none)
    seen from the previous camera. Where positions and cameras say that nothing moved, the motion is zero, not the
    rounding of a projection, which would blur a still image a little more with every frame. The consistency test
    compares the previous frame's positions with the previous positions too, so that moving surfaces keep their history.
    It compares the normals of both frames: a surface that turns by more than the normal limit starts a new history.

    Fireflies are clamped before accumulation. Where clamping would remove more than 10 % of the light of the median
    32x32 block of a shot's first frame (separately for each image of a batch), the shot has caustics, and the limit is
    120. Light that is there in frame after frame is no firefly: the method does not see it, as it would take it for
    noise, and it is added to the image as it is. :func:`mcdenoise.ops._steps.history.blend` shortens the histories of
    mirrors and of changing light.

    A lamp in the plane of a ceiling, with the albedo of the ceiling, is the same surface by all tests, and bilinear
    taps would carry its light over its edge, a little further with every frame. So pixels that see a light take their
    history from pixels that saw one, and all others from the others, where both are among the taps. A pixel sees a
    light if :func:`mcdenoise.ops._steps.history.lights` finds one there, and its compressed radiance varied by less
    than a tenth over the history. A light that is narrower than three pixels still bleeds. This needs the test for lag.

    Half-precision frames are accumulated in float32, which is as exact after 10,000 frames as after ten.

    Layers and alpha have histories with the same motion, weights and cuts, which depend on the color alone; where a
    firefly is scaled down, its layers are, too.

    Args:
        inner: any method.
        alpha_min: smallest weight of the current frame, in (0, 1], see :func:`mcdenoise.ops.accumulate`.
        firefly_limit: see :func:`mcdenoise.ops.clamp_fireflies`, infinity for none; by default chosen as above.
        specular_length: the longest history of mirrors and glass while the image moves, in frames, at least 0; infinity
            treats them as everything else.
        lag_threshold: see :func:`mcdenoise.ops.history_lag`; infinity makes no test for changes of light.
        also: names of further buffers to accumulate with the weights of the color, where a frame has them: buffers
            ``(B, 3, H, W)`` of ``frame.extra``, whose fireflies are kept; or ``"diffuse"`` and ``"specular"``, which
            the method sees accumulated.

    Raises:
        InputError: a setting is out of its range.
    """

    stage, whole = "accumulate", True
    takes = MOTION | GUIDES | {"view_projection"}
    gives = frozenset({"current", "recent", "length"})

    def __init__(
        self,
        inner: Model,
        *,
        alpha_min: float = 0.1,
        firefly_limit: float | None = None,
        specular_length: float = SPECULAR_LENGTH,
        lag_threshold: float = THRESHOLD,
        also: Sequence[str] = (),
    ) -> None:
        super().__init__(inner)
        if not 0 < alpha_min <= 1:
            raise InputError(f"alpha_min: expected in (0, 1], found {alpha_min}")
        if not specular_length >= 0:
            raise InputError(f"specular_length: expected at least 0, found {specular_length}")
        self.alpha_min, self.firefly_limit = alpha_min, firefly_limit
        self.specular_length, self.lag_threshold = specular_length, lag_threshold
        self.also = tuple(also)

    # An attribute would be a setting for the training, which makes the wrappers at a model's outside anew.
    @property
    def persistence(self) -> float:
        """The fraction of the history that each frame keeps."""
        return 1 - self.alpha_min

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """None: those of the method inside are of the accumulated radiance."""
        return {}

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        kept, inner = own_pair(state, "accumulated")
        channels = RECENT.stop if math.isfinite(self.lag_threshold) else COLOR.stop
        history = own_state(kept, History, frame, channels=channels)
        frame = frame.with_depth()
        reset = reset_of(frame, history)
        if history is not None and not reset:
            reset = self._other_buffers(history, frame)
        keeps = frame.hints.keep_all or not frame.hints.last
        # A frame without a history, which will not be part of one, needs no test for lag.
        compared = math.isfinite(self.lag_threshold) and (keeps or not reset)
        found = self._blended(frame, None if reset else history, reset, compared)
        if found.reset:
            inner = None
        elif (cut := found.cut) is not None:
            inner = pytree.tree_map_only(
                Tensor, lambda part: part.masked_fill(cut.view(-1, *[1] * (part.dim() - 1)), 0), inner
            )
        light, passing = self._lasting(frame, None if found.reset not in ("", NO_MOTION) else history, found)
        still = found.still is True
        notes = [*self._notes(frame, still=still, keeps=keeps), found.note]
        color, carried = found.history.color, found.history.carried
        after = found.history._replace(light=light) if keeps else None
        # Statistics of the noisy image are not passed on.
        made = {"color": color[:, COLOR], "current": found.entering[:, COLOR], "length": found.history.length}
        if color.shape[1] > COLOR.stop:
            made["recent"] = color[:, RECENT.start : RECENT_MEAN.start]
        given = frame.replace(**made, statistics={}, hints=frame.hints._replace(still=still))
        given = self._with_carried(given, carried)
        del frame, found, made, color, carried
        output, inner = self.inner(given, inner)
        output = completed(given, output)
        stages = {"accumulated": given.color, **output.stages}
        if passing is not None:
            layers = {name: layer + passing.layers[name] for name, layer in output.layers.items()}
            output = output._replace(image=output.image + passing.image, layers=layers)
        next_state = None if after is None and inner is None else (after, inner)
        return output._replace(stages=stages).noted(*notes), next_state

    def _blended(self, frame: Frame, history: History | None, reset: str, compared: bool) -> _Blended:
        """The frame with its history, where it has one and there is no cut."""
        # In a graph and on a GPU no value is read: both branches of each decision are computed.
        blind = not at_hand(frame.color.device)
        limit = self._chosen(frame.color) if history is None else history.limit
        if blind and history is not None:
            limit = torch.where(limit > 0, limit, self._chosen(frame.color))
        entering = self._incoming(frame, limit, compared=compared)
        seen = lights(entering[:, MEAN]) if compared else None
        if history is None:
            return self._begun(frame, entering, limit, seen, reset)
        motion, still = motion_unless_still(frame, history.view_projection)
        color, length, kept = self._blend(frame, entering, history.color, seen, history, motion)
        found, cut = kept.mean(), (kept < CUT_FRACTION)[:, None, None, None]
        if not blind and cut.any():
            # The light of a new shot may differ, and the cut is found only here.
            limit = torch.where(cut, self._chosen(frame.color), limit)
            entering = self._incoming(frame, limit, compared=compared)
            if cut.all():
                return self._begun(frame, entering, limit, seen, "cut")._replace(found=found)
        carried = self._blend_carried(frame, entering, seen, history, motion)
        if not blind and not cut.any():
            after = _history(frame, color, length, limit, carried, seen)
            return _Blended(after, entering, limit, motion, still, "", found)
        carried = tuple(
            None if part is None or old is None else torch.where(cut, part, old)
            for part, old in zip(self._first(frame, entering), carried, strict=True)
        )
        color, length = torch.where(cut, without_history(entering), color), torch.where(cut, 1, length)
        after = _history(frame, color, length, torch.where(cut, 0, limit) if blind else limit, carried, seen)
        return _Blended(after, entering, limit, motion, still, "", found, cut)

    def _incoming(self, frame: Frame, limit: Tensor, *, compared: bool) -> Tensor:
        # As a number, infinity takes no pass over the image.
        unclamped = self.firefly_limit == math.inf
        return incoming(frame.color, math.inf if unclamped else limit, compared=compared)

    def _begun(self, frame: Frame, entering: Tensor, limit: Tensor, seen: Tensor | None, reset: str) -> _Blended:
        """A frame without a history."""
        color, length = without_history(entering), torch.ones_like(entering[:, :1])
        after = _history(frame, color, length, limit, self._first(frame, entering), seen)
        return _Blended(after, entering, limit, None, False, reset)

    def _lasting(self, frame: Frame, history: History | None, found: _Blended) -> tuple[Tensor | None, Output | None]:
        """How much light lasts, for the next frame; and what of this frame passes the method, ``None`` for nothing."""
        if self.firefly_limit == math.inf:
            return None, None
        clamped = found.entering[:, COLOR]
        full, least = light_of(frame.color.to(clamped.dtype)), light_of(clamped)
        before = None if history is None else history.light
        if before is not None and found.cut is not None:
            before = torch.where(found.cut, 0, before)
        light = believed(full, least, found.limit.to(full.dtype), before, found.motion)
        if at_hand(light.device) and not (light > least).any():
            return light, None
        after = torch.maximum(light, least)
        layers = {
            name: with_light(layer, full, after) - with_light(layer, full, least)
            for name, layer in frame.layers.items()
        }
        return light, Output(with_light(frame.color.to(clamped.dtype), full, after) - clamped, layers=layers)

    def _first(self, frame: Frame, entering: Tensor) -> _Carried:
        """Layers, alpha and the buffers of ``also`` of a frame without a history."""
        parts = self._entering(frame, entering)
        # With the test for lag, each has its recent mean behind it.
        twice = entering.shape[1] > COLOR.stop
        return tuple(torch.cat([part, part], 1) if twice and part is not None else part for part in parts)

    def _blend_carried(
        self, frame: Frame, entering: Tensor, seen: Tensor | None, history: History, motion: Tensor | None
    ) -> _Carried:
        """Layers, alpha and the buffers of ``also`` of a frame, with their histories.

        Each takes the place of the color in the blend, whose decisions depend on the compressed radiance only.
        """
        decisive = entering[:, COLOR.stop :]
        blended: list[Tensor | None] = []
        for part, before in zip(self._entering(frame, entering), history.carried, strict=True):
            if part is None or before is None:
                blended.append(None)
                continue
            previous = [before[:, COLOR], history.color[:, MEAN.start : SQUARE.stop], before[:, COLOR.stop :]]
            previous = [*previous, history.color[:, RECENT_MEAN]] if decisive.shape[1] else previous
            together = torch.cat([part, decisive], 1), torch.cat(previous, 1)
            color = self._blend(frame, *together, seen, history, motion)[0]
            recent = color[:, RECENT.start : RECENT_MEAN.start]
            blended.append(torch.cat([color[:, COLOR], recent], 1) if decisive.shape[1] else color)
        return tuple(blended)

    def _blend(
        self,
        frame: Frame,
        entering: Tensor,
        before: Tensor,
        seen: Tensor | None,
        history: History,
        motion: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Color and length of the frame with its history, and how many pixels of each image have one."""
        surface, previous = comparable(surface_before(frame)._replace(label=seen), history.surface)
        return blend(
            *(entering, before, history.length, motion, surface, previous),
            alpha_min=self.alpha_min,
            albedo=frame.albedo,
            specular_length=self.specular_length,
            lag_threshold=self.lag_threshold,
        )

    def _entering(self, frame: Frame, entering: Tensor) -> list[Tensor | None]:
        """Layers (without fireflies), alpha and the buffers of ``also`` as they enter the history: ``(B, 3, H, W)``."""
        layers = (layer.to(entering.dtype) for layer in frame.layers.values())
        parts: list[Tensor | None] = [with_light(layer, frame.color, entering[:, COLOR]) for layer in layers]
        if (alpha := alpha_of(frame)) is not None:
            parts.append(alpha.expand(-1, COLOR.stop, -1, -1))
        parts += [frame.buffer(name) for name in self.also]
        return [None if part is None else part.to(entering.dtype) for part in parts]

    def _with_carried(self, frame: Frame, carried: _Carried) -> Frame:
        """The frame with the layers, the alpha and the buffers of its history."""
        if not carried:
            return frame
        parts: Iterator[Any] = iter(carried)
        layers = {name: next(parts)[:, COLOR] for name in frame.layers}
        alpha = frame.alpha if alpha_of(frame) is None else next(parts)[:, :1]
        also = {name: part[:, COLOR] for name, part in zip(self.also, parts, strict=True) if part is not None}
        own = {name: also.pop(name) for name in RADIANCE if name in also}
        return frame.replace(layers=layers, alpha=alpha, extra={**frame.extra, **also}, **own)

    def _other_buffers(self, history: History, frame: Frame) -> str:
        """The reason why the histories beside the color cannot be continued; empty if they can.

        Raises:
            InputError: they are of another method, or of other layers.
        """
        before, now = len(history.carried), len(frame.layers) + (alpha_of(frame) is not None) + len(self.also)
        if before != now:
            raise InputError(
                f"state: expected what accumulated keeps of {now} images beside the color, found it of {before}: of "
                f"another method or other layers; {ADVICE}"
            )
        there = [frame.buffer(name) is not None for name in self.also]
        same = there == [part is not None for part in history.carried[now - len(there) :]]
        return "" if same else "other buffers than in the frame before"

    def _chosen(self, color: Tensor) -> Tensor:
        """The limit of the fireflies of each image of a shot that begins with this frame."""
        if self.firefly_limit is not None:
            return torch.full_like(color[:, :1, :1, :1], self.firefly_limit, dtype=torch.float32)
        return torch.where(light_of_fireflies(color) > _LOST, _CAUSTICS, LIMIT).reshape(-1, 1, 1, 1).to(torch.float32)

    def _notes(self, frame: Frame, *, still: bool, keeps: bool) -> list[Note]:
        can_move = tells_motion(frame.buffers)
        source = "motion" if frame.motion is not None else "positions and cameras"
        lost = "" if can_move else "no motion, and no positions with cameras: single frames"
        alone = "one frame" if frame.hints.alone and not frame.hints.keep_all else lost
        why = alone or ("nothing moves in the image" if still and not frame.hints.keep_all else "")
        return [
            Note("accumulate", alone or source, float(alone != "")),
            Note("reproject", why or source, float(why != "")),
            Note("remember", "for the next frame" if keeps else alone or "last frame", float(not keeps)),
        ]


def _history(
    frame: Frame, color: Tensor, length: Tensor, limit: Tensor, carried: _Carried, seen: Tensor | None
) -> History:
    """The history with a frame that sees lights there, of which those count whose radiance has hardly varied."""
    # In most frames no light is seen, and all labels are 0.
    if seen is not None and not (at_hand(seen.device) and not seen.any()):
        mean = color[:, MEAN]
        seen = seen * (color[:, SQUARE] - mean.square() <= (_STEADY * mean).square())
    surface = Surface(frame.position, frame.normal, frame.depth, seen)
    return History(color, length, surface, frame.view_projection, limit, carried)
