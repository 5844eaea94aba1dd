"""The Gaussian of the a-trous filter ."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from mcdenoise.ops._numba._runtime import compiled, share_rows


def blurred(variance: Tensor) -> Tensor:
    """See :func:`mcdenoise.ops.atrous.blurred`."""
    result = torch.empty(variance.shape, dtype=variance.dtype, device="cpu")
    if result.numel():
        arrays = result.numpy(), variance.detach().contiguous().numpy()
        share_rows(variance, lambda *rows: _blur(*arrays, *rows))
    return result


@compiled
def _blur(out: Any, image: Any, b: int, first: int, last: int) -> None:
    """Rows ``first`` to ``last``, ``(1, 2, 1) / 4`` along each axis."""
    _, _, height, width = image.shape
    number = out.dtype.type
    half, quarter = number(0.5), number(0.25)
    column = np.empty(width + 2, out.dtype)
    for y in range(first, last):
        above, here, below = image[b, 0, max(y - 1, 0)], image[b, 0, y], image[b, 0, min(y + 1, height - 1)]
        inner, row = column[1 : width + 1], out[b, 0, y]
        for x in range(width):
            inner[x] = half * here[x] + quarter * (above[x] + below[x])
        column[0], column[width + 1] = inner[0], inner[width - 1]
        for x in range(width):
            row[x] = half * inner[x] + quarter * (column[x] + column[x + 2])
