"""Where the surfaces of a frame were in the frame before, and whether anything has moved."""

from __future__ import annotations

import torch
from torch import Tensor

from mcdenoise.frame import Frame
from mcdenoise.models._reads import at_hand
from mcdenoise.ops import Surface, motion_from_position


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
    """Motion as :func:`motion_to_previous` has it where something moves, else ``None``; and :func:`is_still`."""
    still = is_still(frame, previous_view_projection)
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


def is_still(frame: Frame, previous_view_projection: Tensor | None) -> bool | Tensor:
    """Whether nothing moved in the image since the frame before, as far as the frame tells.

    Returns:
        Whether its motion is zero everywhere, or else the camera is the same and no position differs from its previous
        position; a tensor where values are not at hand, or ``(B, 1, 1, 1)`` for a batch of which not all are still.
    """
    blind = not at_hand(frame.color.device)
    if frame.motion is not None:
        if blind:
            return ~frame.motion.any()
        return not (_thinned(frame.motion).any() or frame.motion.any())
    pairs = [(previous_view_projection, frame.view_projection)]
    if frame.previous_position is not None:
        pairs.append((frame.position, frame.previous_position))
    known = [(a, b) for a, b in pairs if a is not None and b is not None]
    if frame.position is None or len(known) < len(pairs):
        return False
    if not blind:
        still = all(_equal(a, b) for a, b in known)
        if still or len(frame.color) == 1:
            return still
    return torch.stack([torch.eq(a, b).flatten(1).all(1) for a, b in known]).all(0)[:, None, None, None]


def _equal(a: Tensor, b: Tensor) -> bool:
    return a is b or (torch.equal(_thinned(a), _thinned(b)) and torch.equal(a, b))


def _thinned(image: Tensor) -> Tensor:
    """One pixel in 64: enough to detect most motion."""
    return image[..., ::8, ::8]
