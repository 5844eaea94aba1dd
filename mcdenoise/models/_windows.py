"""The blend of a frame with its history, some rows at a time, with no more of the history than these rows need."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from mcdenoise.models._spilled import drop_pages, empty_spilled, spilled
from mcdenoise.ops import Surface
from mcdenoise.ops._steps.history import SQUARE, Blended, blend
from mcdenoise.ops.lag import KERNEL_SIZE

# Pixels of a window: larger ones take more memory, smaller ones compute more rows twice.
_PIXELS = 1 << 21
# Rows around a row that its test for lag looks at, in half the resolution.
_REACH = 2 * (KERNEL_SIZE // 2) + 2


def blend_in_windows(
    entering: Tensor,
    previous: Tensor,
    previous_length: Tensor,
    motion: Tensor | None,
    surface: Surface,
    previous_surface: Surface,
    *,
    albedo: Tensor | None = None,
    **settings: Any,
) -> Blended:
    """As :func:`mcdenoise.ops._steps.history.blend`, up to the rounding of positions; the result is in a file.

    A window of rows is blended with the same rows of the history, which are so many that they hold all that the
    motion of some rows leads to.
    """
    batch, _, height, width = entering.shape
    color, length = (empty_spilled((batch, *each.shape[1:]), each.dtype) for each in (previous, previous_length))
    kept = torch.zeros(batch)
    motion = None if motion is None else spilled(motion)
    drop_pages()
    step = max(_PIXELS // (batch * width) // 2 * 2, 2)
    for top in range(0, height, step):
        bottom = min(top + step, height)
        first, end = _window(motion, top, bottom, height)

        def rows(image: Tensor | None, first: int = first, end: int = end) -> Any:
            return None if image is None else image[..., first:end, :]

        part = blend(
            *(rows(entering), rows(previous), rows(previous_length), rows(motion)),
            *(Surface(*map(rows, each)) for each in (surface, previous_surface)),
            albedo=rows(albedo),
            **settings,
        )
        color[..., top:bottom, :] = part.color[..., top - first : bottom - first, :]
        own = part.length[..., top - first : bottom - first, :]
        length[..., top:bottom, :] = own
        kept += (own > 1).sum((1, 2, 3))
        del part, own
        drop_pages()
    return Blended(color, length, kept / (height * width))


def first_in_file(entering: Tensor) -> Tensor:
    """As :func:`mcdenoise.ops._steps.history.without_history`; the result is in a file."""
    again = entering[:, : SQUARE.start] if entering.shape[1] > SQUARE.start else entering[:, :0]
    batch, channels, height, width = entering.shape
    result = empty_spilled((batch, channels + again.shape[1], height, width), entering.dtype)
    for channel, image in enumerate((*entering.unbind(1), *again.unbind(1))):
        result[:, channel] = image
        drop_pages()
    return result


def _window(motion: Tensor | None, top: int, bottom: int, height: int) -> tuple[int, int]:
    """The range of rows that contains rows of a frame, their neighbours, and the places to which their motion leads."""
    first, end = max(top - _REACH, 0), min(bottom + _REACH, height)
    if motion is not None:
        numbers = torch.arange(first, end, dtype=motion.dtype)[:, None]
        found = motion[:, 1, first:end] + numbers
        inside = found[(found > -1) & (found < height)]
        if inside.numel():
            first = max(min(first, math.floor(float(inside.min()))), 0)
            end = min(max(end, math.ceil(float(inside.max())) + 1), height)
    # Pairs of rows stay together.
    return first // 2 * 2, end
