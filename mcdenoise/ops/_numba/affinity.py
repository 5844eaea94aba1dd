"""The affinity filter.

The kernels go row by row and tap by tap over a run of pixels, whose distances and weights stay in the first-level
cache. Taps beyond the image are not computed.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mcdenoise.ops._constants import FARTHEST_FEATURE, LEAST_CENTER
from mcdenoise.ops._numba._runtime import add, add_product, compiled, exp, multiply, share_rows
from mcdenoise.ops._window import accumulator_dtype

_CHUNK = 512


class _Inputs(NamedTuple):
    """Arrays ``(B, C, H, W)`` in the dtype of the sums; those of a frame before that is not there are empty."""

    image: Any
    features: Any
    bandwidth: Any
    center: Any
    previous: Any
    previous_features: Any
    previous_bandwidth: Any
    previous_weight: Any
    kernel_size: int
    dilation: int


def affinity_filter(*arguments: Any) -> Tensor:
    """See :func:`mcdenoise.ops.affinity_filter`."""
    image, *_, kernel_size, dilation = arguments
    dtype = accumulator_dtype(image.dtype)
    out = torch.empty(image.shape, dtype=dtype, device="cpu")
    if out.numel():
        nothing = out.new_empty((0, 0, 0, 0))
        tensors = [nothing if each is None else each.detach().to(dtype).contiguous() for each in arguments[:8]]
        inputs = _Inputs._make([*(tensor.numpy() for tensor in tensors), kernel_size, dilation])
        share_rows(image, lambda *rows: _average(out.numpy(), inputs, *rows))
    return out.to(image.dtype)


@compiled
def _average(out: Any, inputs: Any, b: int, first: int, last: int) -> None:
    """Rows ``first`` to ``last`` of the result."""
    _, channels, height, width = out.shape
    radius, dilation = inputs.kernel_size // 2, inputs.dilation
    image, features, bandwidth, center, previous, there, width_there, known = inputs[:8]
    buffers = np.empty((3, min(width, _CHUNK)), out.dtype)
    least = out.dtype.type(LEAST_CENTER)
    for y in range(first, last):
        for x0 in range(0, width, _CHUNK):
            x1 = min(x0 + _CHUNK, width)
            total = buffers[2]
            for x in range(x0, x1):
                own = center[b, 0, y, x]
                # A NaN is not less.
                total[x - x0] = least if own < least else own
            for c in range(channels):
                for x in range(x0, x1):
                    out[b, c, y, x] = total[x - x0] * image[b, c, y, x]
            for dy in range(-radius, radius + 1):
                row = y + dy * dilation
                if row < 0 or row >= height:
                    continue
                for dx in range(-radius, radius + 1):
                    left, right = max(x0, -dx * dilation), min(x1, width - dx * dilation)
                    if right <= left:
                        continue
                    start, end = left + dx * dilation, right + dx * dilation
                    square, weight, sums = (
                        buffers[0, : right - left],
                        buffers[1, : right - left],
                        total[left - x0 : right - x0],
                    )
                    if dx != 0 or dy != 0:
                        _square(square, features, features, b, y, left, row, start)
                        _weigh(weight, square, bandwidth[b, 0, y, left:right])
                        add(sums, weight)
                        for c in range(channels):
                            add_product(out[b, c, y, left:right], weight, image[b, c, row, start:end])
                    if previous.size > 0:
                        _square(square, features, there, b, y, left, row, start)
                        _weigh(weight, square, width_there[b, 0, y, left:right])
                        multiply(weight, known[b, 0, row, start:end])
                        add(sums, weight)
                        for c in range(channels):
                            add_product(out[b, c, y, left:right], weight, previous[b, c, row, start:end])
            for c in range(channels):
                for x in range(x0, x1):
                    out[b, c, y, x] /= total[x - x0]


@compiled
def _square(total: Any, own: Any, others: Any, b: int, y: int, x: int, row: int, start: int) -> None:
    """``|own[p] - others[q]|^2`` of a run of pixels and of their taps."""
    n, most = total.size, total.dtype.type(FARTHEST_FEATURE)
    total[:] = 0
    for c in range(own.shape[1]):
        here, there = own[b, c, y, x : x + n], others[b, c, row, start : start + n]
        for i in range(n):
            difference = _near(here[i] - there[i], most)
            total[i] += difference * difference


@compiled
def _near(difference: Any, most: Any) -> Any:
    """Within the farthest; a NaN, which is not less or more, stays."""
    below = most if difference > most else difference
    return -most if below < -most else below


@compiled
def _weigh(weight: Any, square: Any, bandwidth: Any) -> None:
    for i in range(weight.size):
        weight[i] = exp(-(bandwidth[i] * square[i]))
