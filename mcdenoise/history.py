"""The accumulated past of one shot: what is kept from frame to frame, and when it is thrown away."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from mcdenoise.buffers import Frame
from mcdenoise.ops import Accumulate, Surface, demodulate, motion_from_position

# A cut leaves a few accidental matches; a fast pan keeps far more than this share of the image.
_CUT_SHARE = 0.05


class Accumulated(NamedTuple):
    """One frame after accumulation.

    Args:
        color: ``(B, 3, H, W)`` accumulated demodulated radiance.
        length: ``(B, 1, H, W)`` history length in frames, 1 where there is none.
        reset: why the past was thrown away, or ``""`` where it was used.
    """

    color: Tensor
    length: Tensor
    reset: str


class _State(NamedTuple):
    color: Tensor
    length: Tensor
    surface: Surface
    view_projection: Tensor | None


class History:
    """Demodulates frames and accumulates them, one after the other.

    The motion is the frame's own where it has one, else that of its positions seen from the previous camera; with
    neither there is no past. The past is thrown away by :meth:`reset`, when the image size changes, and at a cut (less
    than 5 % of the pixels find their surface in the previous frame).

    Args:
        accumulate: the rule and its limits; by default those that scale with depth. The published BMFR rule is
            ``Accumulate(0.2, "bmfr", position_limit, normal_limit)`` with the scene's squared limits.
    """

    def __init__(self, accumulate: Accumulate | None = None) -> None:
        self.accumulate = Accumulate() if accumulate is None else accumulate
        self._state: _State | None = None

    def reset(self) -> None:
        """Forget the past: the next frame is the first of a shot."""
        self._state = None

    def update(self, frame: Frame) -> Accumulated:
        """Add a frame.

        Args:
            frame: the next frame; its values must be valid (:meth:`mcdenoise.buffers.Frame.validate`).
        """
        frame = frame.with_depth()
        color = frame.color if frame.albedo is None else demodulate(frame.color, frame.albedo)
        surface = Surface(frame.position, frame.normal, frame.depth)
        result = self._blend(frame, color, surface)
        self._state = _State(result.color, result.length, surface, frame.view_projection)
        return result

    def _blend(self, frame: Frame, color: Tensor, surface: Surface) -> Accumulated:
        state = self._state
        first = Accumulated(color, torch.ones_like(color[:, :1]), "first frame")
        if state is None:
            return first
        if state.color.shape != color.shape or state.color.device != color.device:
            return first._replace(reset="size change")
        if frame.motion is not None:
            motion = frame.motion
        elif frame.position is not None and state.view_projection is not None:
            motion = motion_from_position(frame.position, state.view_projection)
        else:
            return first._replace(reset="no motion, and no position with a previous camera")
        accumulated, length = self.accumulate(color, state.color, state.length, motion, surface, state.surface)
        if float((length > 1).float().mean()) < _CUT_SHARE:
            return first._replace(reset="cut")
        return Accumulated(accumulated, length, "")
