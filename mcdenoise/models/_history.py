"""What a method keeps of a frame, and what the next frame sees of it: motion, surfaces, changes of size, the state."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from mcdenoise.frame import Frame, tells_motion
from mcdenoise.models._interface import Note, State, at_hand
from mcdenoise.models._state import own_state
from mcdenoise.ops import Surface, motion_from_position, reproject, resample

# Why a frame has no history where it does not tell what its pixels were before.
NO_MOTION = "no motion, and no position with a previous camera"
_ROUNDED = 8  # largest rounding error of the weight of all four taps, which is 1, in units of eps


class Past(NamedTuple):
    """Images of a frame for the next one. Zeros stand for no frame: their weight is 0.

    Args:
        image: ``(B, C, H, W)`` the channels to reproject.
        weight: ``(B, 1, 1, 1)`` 1, or 0 if there was no frame.
        surface: what the frame shows; empty if surfaces are not to be compared.
        view_projection: ``(B, 4, 4)`` camera of the frame.
    """

    image: Tensor
    weight: Tensor
    surface: Surface
    view_projection: Tensor | None

    @staticmethod
    def of(frame: Frame, image: Tensor, *, surfaces: bool = True) -> Past | None:
        """Keep an image of a frame, and its surface; ``None`` after the last frame."""
        if not _keeps(frame):
            return None
        surface = Surface(frame.position, frame.normal, frame.depth) if surfaces else Surface()
        return Past(image, torch.ones_like(image[:, :1, :1, :1]), surface, frame.view_projection)


class Reprojected(NamedTuple):
    """The frame before, seen from this one.

    Args:
        image: ``(B, C, H, W)``; zero where there is nothing.
        weight: ``(B, 1, H, W)`` in [0, 1], the fraction that shows the same surface.
        notes: about the history.
    """

    image: Tensor
    weight: Tensor
    notes: tuple[Note, ...]


def reset_of(frame: Frame, before: Any) -> str:
    """Why a frame cannot continue a history; empty if it can.

    Args:
        frame: the current frame.
        before: what is kept of the frame before, a named tuple that begins with an image and has a
            ``view_projection``; ``None`` if there was none.
    """
    if before is None:
        return "first frame" if tells_motion(frame.buffers) else NO_MOTION
    if before[0].shape[2:] != frame.color.shape[2:]:
        return "size change"
    told = frame.motion is not None or (tells_motion(frame.buffers) and before.view_projection is not None)
    return "" if told else NO_MOTION


def surface_before(frame: Frame) -> Surface:
    """The surfaces of a frame at their positions in the frame before, with the current normals and depths."""
    before = frame.position if frame.previous_position is None else frame.previous_position
    return Surface(before, frame.normal, frame.depth)


def motion_to_previous(frame: Frame, previous_view_projection: Tensor | None) -> Tensor | None:
    """The motion of each pixel's surface point: its place in the frame before minus its place now.

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


def motion_unless_still(frame: Frame, previous_view_projection: Tensor | None) -> tuple[Tensor | None, bool | Tensor]:
    """Motion as :func:`motion_to_previous` has it where something moves, else ``None``; and :func:`_is_still`."""
    still = _is_still(frame, previous_view_projection)
    if still is True and not (frame.hints.keep_all and frame.motion is not None):
        return None, still
    motion = motion_to_previous(frame, previous_view_projection)
    if isinstance(still, Tensor) and motion is not None:
        motion = torch.where(still, 0, motion)
    return motion, still


def comparable(surface: Surface, previous: Surface) -> tuple[Surface, Surface]:
    """Two surfaces for the relative test: without a depth, positions are not compared."""
    if surface.depth is not None and previous.depth is not None:
        return surface, previous
    return surface._replace(position=None), previous._replace(position=None)


def _is_still(frame: Frame, previous_view_projection: Tensor | None) -> bool | Tensor:
    """Whether nothing moved in the image since the frame before, as far as the frame tells.

    Returns:
        Whether its motion is zero everywhere, or else the camera is the same and no position differs from its previous
        position; a tensor where values are not at hand, or ``(B, 1, 1, 1)`` for a batch of which not all are still.
    """
    blind = not at_hand(frame.color.device)
    if frame.motion is not None:
        if blind:
            return ~frame.motion.any()
        return not frame.motion.any()
    pairs = [(previous_view_projection, frame.view_projection)]
    if frame.previous_position is not None:
        pairs.append((frame.position, frame.previous_position))
    known = [(a, b) for a, b in pairs if a is not None and b is not None]
    if frame.position is None or len(known) < len(pairs):
        return False
    if not blind:
        still = all(a is b or torch.equal(a, b) for a, b in known)
        if still or len(frame.color) == 1:
            return still
    return torch.stack([torch.eq(a, b).flatten(1).all(1) for a, b in known]).all(0)[:, None, None, None]


def reprojected(frame: Frame, state: State, channels: int, keeper: str, *, sharp: bool = False) -> Reprojected:
    """Reproject the images of the frame before to this frame.

    Args:
        frame: with a depth, if it can be computed (:meth:`mcdenoise.frame.Frame.with_depth`).
        state: result of :meth:`Past.of`, or ``None``.
        channels: number of channels of the image.
        keeper: name of the method for messages.
        sharp: whether pixels whose four nearest show the same surface are resampled by bicubic interpolation.

    Raises:
        InputError: the state belongs to another method.
    """
    before = own_state(state, Past, frame, channels=channels, keeper=keeper)
    reset = reset_of(frame, before)
    if before is None or reset:
        shape = (frame.color.shape[0], channels, *frame.size)
        none = torch.zeros_like(frame.color[:, :1])
        return Reprojected(frame.color.new_zeros(shape), none, _notes(frame, reset, 0.0))
    motion, _ = motion_unless_still(frame, before.view_projection)
    found, weight = reproject(before.image, motion, *comparable(surface_before(frame), before.surface))
    if sharp and motion is not None:
        whole = weight > 1 - _ROUNDED * torch.finfo(weight.dtype).eps
        found = torch.where(whole, resample(before.image, motion), found)
    weight = weight * before.weight
    return Reprojected(found, weight, _notes(frame, "", weight.mean()))


def _keeps(frame: Frame) -> bool:
    return frame.hints.keep_all or not frame.hints.last


def _notes(frame: Frame, reset: str, history: float | Tensor) -> tuple[Note, ...]:
    keeps = _keeps(frame)
    return (
        Note("history", reset, value=history),
        Note("reproject", reset or "the image of the frame before", float(reset != "")),
        Note("remember", "for the next frame" if keeps else "last frame", float(not keeps)),
    )
