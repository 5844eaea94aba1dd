"""A method that is given its own image of the frame before, as it is seen from here."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from mcdenoise.frame import MOTION, Frame
from mcdenoise.models._interface import Needs, Output, State
from mcdenoise.models._journal import journal, note, tell_history, timed
from mcdenoise.models._state import own_state
from mcdenoise.models._wrapper import Wrapper
from mcdenoise.models.accumulated import comparable, has_motion, motion_unless_still, surface_before
from mcdenoise.ops import Surface, demodulate, remodulate, reproject

# The image of the frame before at the places of this one, and how much of each of its pixels shows the same surface.
PREVIOUS, PREVIOUS_WEIGHT = "previous", "previous_weight"
PREVIOUS_LIGHT = "previous_light"  # the same with the albedo of this frame


class Before(NamedTuple):
    """What is kept of a frame. All of it zeros is that of no frame: nothing there shows what is here.

    Args:
        image: ``(B, C, H, W)`` what is reprojected; of :class:`Recurrent`, 6 channels: what the method made of the
            frame, and the same without albedo.
        weight: ``(B, 1, 1, 1)`` 1, or 0 where there was no frame.
        surface: what was seen.
        view_projection: ``(B, 4, 4)`` by which camera.
    """

    image: Tensor
    weight: Tensor
    surface: Surface
    view_projection: Tensor | None


class Recurrent(Wrapper):
    """Hands a method its image of the frame before, reprojected.

    The method finds it in ``frame.extra``, ``(B, 3, H, W)`` each, 0 where nothing shows the same surface:

    - ``previous``: that image itself. Every reprojection blurs it a little more.
    - ``previous_light``: its radiance without albedo, with the albedo of this frame. What is textured stays sharp; but
      the albedo of few samples a pixel has noise of its own.

    ``previous_weight`` ``(B, 1, H, W)`` in [0, 1] is how much of it shows the same surface, see
    :func:`mcdenoise.ops.reproject`: of the first frame, and where nothing tells how things move, 0. What blends its
    image with those is steady and has the noise of many frames; it is trained over clips to tell where they no longer
    hold.

    Args:
        inner: a method without a state.
    """

    @property
    def needs(self) -> Needs:
        """As those inside but for what is handed to it; whatever tells motion is of use."""
        needs = self.inner.needs
        given = frozenset({PREVIOUS, PREVIOUS_LIGHT, PREVIOUS_WEIGHT})
        uses = (needs.uses - given) | MOTION | {"view_projection", "normal", "depth"}
        return Needs(needs.buffers - given, uses, needs.trainable, None)

    @property
    def persistence(self) -> float | None:
        """Nobody knows what a network has learnt to keep of its images; what blends with them says so itself."""
        inside = self.inner.modules() if isinstance(self.inner, nn.Module) else ()
        return 0.0 if any(hasattr(each, "persistence") for each in inside) else None

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        frame = frame.with_depth()
        with timed("accumulate", frame.color.device):
            image, weight = from_before(frame, state, channels=6)
        image, light = image.split(3, 1)
        light = light if frame.albedo is None else remodulate(light, frame.albedo)
        before = {PREVIOUS: image, PREVIOUS_LIGHT: light, PREVIOUS_WEIGHT: weight}
        handed = frame.replace(extra={**frame.extra, **before})
        output, _ = self.inner(handed)
        light = output.image if frame.albedo is None else demodulate(output.image, frame.albedo)
        return output, to_be_kept(frame, torch.cat([output.image, light], 1))


def to_be_kept(frame: Frame, image: Tensor) -> Before | None:
    """What is kept of a frame and of an image of it ``(B, C, H, W)`` for the next one; nothing of the last frame."""
    keeps = frame.hints.keep_all or not frame.hints.last
    note("remember", "for the next frame" if keeps else "last frame", float(not keeps))
    if not keeps:
        return None
    surface = Surface(frame.position, frame.normal, frame.depth)
    return Before(image, torch.ones_like(image[:, :1, :1, :1]), surface, frame.view_projection)


def from_before(frame: Frame, state: State, channels: int, keeper: str = "recurrent") -> tuple[Tensor, Tensor]:
    """What was kept of the frame before, at the places of this one.

    Args:
        frame: with a depth, if it has what tells one (:meth:`mcdenoise.frame.Frame.with_depth`).
        state: by :func:`to_be_kept`, or ``None``.
        channels: of the image that is kept.
        keeper: the method, for messages.

    Returns:
        ``(B, channels, H, W)`` image, and ``(B, 1, H, W)`` in [0, 1] how much of it shows the same surface; zeros of a
        first frame, of another size than the one before, and where nothing tells motion.

    Raises:
        InputError: the state is that of another method.
    """
    before = own_state(state, Before, frame, channels=channels, keeper=keeper)
    nothing = frame.color.new_zeros(frame.color.shape[0], channels, *frame.size), torch.zeros_like(frame.color[:, :1])
    if before is None:
        _report("first frame", 0.0)
        return nothing
    if before.image.shape != nothing[0].shape:
        _report("size change", 0.0)
        return nothing
    if not has_motion(frame, before.view_projection):
        _report("no motion", 0.0)
        return nothing
    motion = motion_unless_still(frame, before.view_projection)
    found, weight = reproject(before.image, motion, *comparable(surface_before(frame), before.surface))
    weight = weight * before.weight
    _report("", None)
    tell_history(weight.mean())
    return found, weight


def _report(reset: str, history: float | None) -> None:
    if (found := journal()) is not None:
        found.reset, found.history = reset, history
        note("reproject", reset or "the image of the frame before", float(reset != ""))
