"""Bicubic interpolation at moved places on a CPU: one pass over the pixels, where torch takes more than a hundred."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mcdenoise.ops._constants import CUBIC
from mcdenoise.ops._numba._runtime import compiled, share_rows, source


def resample(previous: Tensor, motion: Tensor) -> Tensor:
    """See :func:`mcdenoise.ops.resample`."""
    dtype = torch.promote_types(previous.dtype, torch.float32)
    value = torch.empty(previous.shape, dtype=dtype, device="cpu")
    if value.numel():
        old = previous.detach().to(dtype).contiguous().reshape(-1)
        arguments = value.numpy(), old.numpy(), source(motion.to(dtype))
        share_rows(previous, lambda *rows: _resample(*arguments, *rows))
    return value.to(previous.dtype)


@compiled
def _resample(value: Any, old: Any, motion: Any, b: int, first: int, last: int) -> None:
    """Neighbours mostly move alike: runs of pixels whose taps are neighbours, too, are vectorised."""
    channels, height, width = value.shape[1:]
    moved, strides, _ = motion
    number = value.dtype.type
    one, zero = number(1), number(0)
    known, left, top = np.empty(width, np.bool_), np.empty(width, np.int64), np.empty(width, np.int64)
    u0, u1, u2, u3 = np.empty((4, width), value.dtype)
    v0, v1, v2, v3 = np.empty((4, width), value.dtype)
    for y in range(first, last):
        for x in range(width):
            at = b * strides[0] + y * strides[2] + x * strides[3]
            right, below = moved[at], moved[at + strides[1]]
            known[x] = math.isfinite(right) and math.isfinite(below)
            # Far outside counts as just outside.
            qx = min(max(number(x) + right, -one), number(width)) if known[x] else zero
            qy = min(max(number(y) + below, -one), number(height)) if known[x] else zero
            left[x], top[x] = np.int64(np.floor(qx)), np.int64(np.floor(qy))
            u0[x], u1[x], u2[x], u3[x] = _kernel(qx - number(left[x]))
            v0[x], v1[x], v2[x], v3[x] = _kernel(qy - number(top[x]))
        start = 0
        while start < width:
            column, row, count = left[start], top[start], 1
            inside = 1 <= column < width - 2
            while inside and start + count < width and column + count < width - 2:
                x = start + count
                if not (known[x] and top[x] == row and left[x] == column + count):
                    break
                count += 1
            # Unsigned: a signed index is first tested for counting from the end, which would prevent vectorisation.
            begin = np.uint64(start)
            x0, x1 = np.uint64(min(max(column - 1, 0), width - 1)), np.uint64(min(max(column, 0), width - 1))
            x2, x3 = np.uint64(min(column + 1, width - 1)), np.uint64(min(column + 2, width - 1))
            for c in range(channels):
                out = value[b, c, y]
                plane = (b * channels + c) * height
                y0 = np.uint64((plane + min(max(row - 1, 0), height - 1)) * width)
                y1 = np.uint64((plane + min(max(row, 0), height - 1)) * width)
                y2 = np.uint64((plane + min(row + 1, height - 1)) * width)
                y3 = np.uint64((plane + min(row + 2, height - 1)) * width)
                # Places of the first pixel's taps, row by row.
                a0, a1, a2, a3 = y0 + x0, y0 + x1, y0 + x2, y0 + x3
                b0, b1, b2, b3 = y1 + x0, y1 + x1, y1 + x2, y1 + x3
                c0, c1, c2, c3 = y2 + x0, y2 + x1, y2 + x2, y2 + x3
                d0, d1, d2, d3 = y3 + x0, y3 + x1, y3 + x2, y3 + x3
                for n in range(np.uint64(count)):
                    i = begin + n
                    p, q, r, s = old[b1 + n], old[b2 + n], old[c1 + n], old[c2 + n]
                    row0 = u0[i] * old[a0 + n] + u1[i] * old[a1 + n] + u2[i] * old[a2 + n] + u3[i] * old[a3 + n]
                    row1 = u0[i] * old[b0 + n] + u1[i] * p + u2[i] * q + u3[i] * old[b3 + n]
                    row2 = u0[i] * old[c0 + n] + u1[i] * r + u2[i] * s + u3[i] * old[c3 + n]
                    row3 = u0[i] * old[d0 + n] + u1[i] * old[d1 + n] + u2[i] * old[d2 + n] + u3[i] * old[d3 + n]
                    total = v0[i] * row0 + v1[i] * row1 + v2[i] * row2 + v3[i] * row3
                    total = max(total, min(min(p, q), min(r, s)))
                    out[i] = min(total, max(max(p, q), max(r, s)))
            start += count
        for x in range(width):
            if not known[x]:
                for c in range(channels):
                    value[b, c, y, x] = zero


@compiled
def _kernel(t: Any) -> Any:
    """See :func:`mcdenoise.ops.resampling._kernel`."""
    number = type(t)
    a, one, two, three = number(CUBIC), number(1), number(2), number(3)
    back = one - t
    before = ((a + two) * t - (a + three)) * t * t + one
    after = ((a + two) * back - (a + three)) * back * back + one
    return a * t * back * back, before, after, a * back * t * t
