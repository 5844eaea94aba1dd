"""A local function of large images, a few rows at a time: the same result, without temporaries of their size."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

# Pixels of a batch to compute at a time. Images of up to 1280x720 are computed at once; more is no faster.
_PIXELS = 1 << 20


def by_rows(function: Callable[..., Tensor], *images: Tensor, reach: int = 0) -> Tensor:
    """``function(*images)``, bit by bit.

    Args:
        function: takes the same rows of every image and returns as many, of any width and number of channels.
        images: ``(B, C, H, W)`` each.
        reach: how many rows away a row of the result may depend on those of the images. Rows of a band begin at a
            multiple of 2 or 4 if this is one.
    """
    batch, _, height, width = images[0].shape
    # A graph that is recorded is for images of other sizes too.
    if torch.compiler.is_compiling() or torch.compiler.is_exporting() or batch * height * width <= _PIXELS:
        return function(*images)
    result: Tensor | None = None
    # A multiple of 4, because the function may halve the resolution on the way, twice.
    step = max(_PIXELS // (batch * width) // 4 * 4, 4)
    for top in range(0, height, step):
        bottom, first = min(top + step, height), max(top - reach, 0)
        rows = function(*(image[..., first : bottom + reach, :] for image in images))
        if result is None:
            result = rows.new_empty((*rows.shape[:2], height, rows.shape[3]))
        result[..., top:bottom, :] = rows[..., top - first : bottom - first, :]
    assert result is not None
    return result
