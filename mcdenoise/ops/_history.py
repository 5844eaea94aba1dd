"""The channels of a history, and the result of blending a frame with it."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

# The channels of a history in which lag is looked for: color, mean of the compressed radiance and of its square, and
# color and compressed radiance of a second, shorter history. A frame enters with the first five.
COLOR, MEAN, SQUARE, RECENT, RECENT_MEAN = slice(0, 3), slice(3, 4), slice(4, 5), slice(5, 9), slice(8, 9)


class Blended(NamedTuple):
    """A frame with its history.

    Args:
        color: ``(B, C, H, W)``, the channels of a history.
        length: ``(B, 1, H, W)`` of the history with this frame, in frames.
        kept: ``(B,)`` fraction of each image's pixels that found their surface in the previous frame, float32.
    """

    color: Tensor
    length: Tensor
    kept: Tensor
