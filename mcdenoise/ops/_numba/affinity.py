"""The affinity filter as a torch operator with derivatives.

The kernels go row by row and tap by tap over a run of pixels, whose distances and weights stay in the first-level
cache. Taps beyond the image are not computed. Derivatives are gathered: each pixel adds up its own contributions as a
tap of other pixels, by their bandwidths and with the same distance, so that no thread writes to another one's rows.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mcdenoise.ops._constants import FARTHEST_FEATURE, LEAST_CENTER
from mcdenoise.ops._numba._runtime import add, add_product, compiled, exp, flushing, multiply, share_rows
from mcdenoise.ops._operator import custom_op
from mcdenoise.ops._window import accumulator_dtype

_CHUNK = 512
_ARGUMENTS = (
    "Tensor image, Tensor features, Tensor bandwidth, Tensor center, Tensor? previous, Tensor? previous_features, "
    "Tensor? previous_bandwidth, Tensor? previous_weight, int kernel_size, int dilation"
)


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


@custom_op("mcdenoise::affinity_filter", device_types="cpu", schema=f"({_ARGUMENTS}) -> Tensor")
def affinity_filter(*arguments: Any) -> Tensor:
    """See :func:`mcdenoise.ops.affinity_filter`."""
    image = arguments[0]
    out, _ = _filtered(image, _inputs(*arguments))
    return out.to(image.dtype)


@affinity_filter.register_fake
def _(image: Tensor, *_: Any) -> Tensor:
    return image.new_empty(image.shape)


def affinity_filter_gradients(needed: tuple[Any, ...], gradient: Tensor, *arguments: Any) -> tuple[Any, ...]:
    """The derivatives in each argument, times ``gradient``."""
    found = iter(_backward(gradient, *arguments))
    return tuple(next(found) if isinstance(each, Tensor) else None for each in arguments)


@custom_op(
    "mcdenoise::affinity_filter_backward", device_types="cpu", schema=f"(Tensor gradient, {_ARGUMENTS}) -> Tensor[]"
)
def _backward(gradient: Tensor, *arguments: Any) -> list[Tensor]:
    """The derivatives in each tensor among the arguments."""
    tensors = [each for each in arguments if isinstance(each, Tensor)]
    inputs = _inputs(*arguments)
    if not gradient.numel():
        return [torch.zeros_like(tensor) for tensor in tensors]
    mean, total = _filtered(gradient, inputs)
    # The derivatives in the sum of weights times values, and in that of the weights with the opposite sign.
    pull = (gradient.to(mean.dtype) / total).contiguous()
    shared = (pull * mean).sum(1, keepdim=True)
    results = [torch.zeros(each.shape, dtype=mean.dtype, device="cpu") for each in inputs[:8]]
    arrays = tuple(each.numpy() for each in results)
    flush = flushing(gradient, arguments[0])

    def run(b: int, first: int, last: int) -> None:
        with flush():
            _gather(arrays, pull.numpy(), shared.numpy(), inputs, b, first, last)

    share_rows(gradient, run)
    return [result.to(tensor.dtype) for result, tensor in zip(results, tensors, strict=False)]


@_backward.register_fake
def _(gradient: Tensor, *arguments: Any) -> list[Tensor]:
    return [each.new_empty(each.shape) for each in arguments if isinstance(each, Tensor)]


def _inputs(*arguments: Any) -> _Inputs:
    image, *_, kernel_size, dilation = arguments
    dtype = accumulator_dtype(image.dtype)
    nothing = torch.empty((0, 0, 0, 0), dtype=dtype, device="cpu")
    tensors = [nothing if each is None else each.detach().to(dtype).contiguous() for each in arguments[:8]]
    return _Inputs._make([*(tensor.numpy() for tensor in tensors), kernel_size, dilation])


def _filtered(image: Tensor, inputs: _Inputs) -> tuple[Tensor, Tensor]:
    """Means, and the sum of the weights of each pixel, in the dtype of the sums."""
    out = torch.empty(image.shape, dtype=accumulator_dtype(image.dtype), device="cpu")
    total = torch.empty((len(image), 1, *image.shape[2:]), dtype=out.dtype, device="cpu")
    if out.numel():
        share_rows(image, lambda *rows: _average(out.numpy(), total.numpy(), inputs, *rows))
    return out, total


@compiled
def _average(out: Any, total: Any, inputs: Any, b: int, first: int, last: int) -> None:
    """Rows ``first`` to ``last`` of the result."""
    _, channels, height, width = out.shape
    radius, dilation = inputs.kernel_size // 2, inputs.dilation
    image, features, bandwidth, center, previous, there, width_there, known = inputs[:8]
    buffers = np.empty((2, min(width, _CHUNK)), out.dtype)
    least = out.dtype.type(LEAST_CENTER)
    for y in range(first, last):
        for x0 in range(0, width, _CHUNK):
            x1 = min(x0 + _CHUNK, width)
            for x in range(x0, x1):
                own = center[b, 0, y, x]
                # A NaN is not less.
                total[b, 0, y, x] = least if own < least else own
            for c in range(channels):
                for x in range(x0, x1):
                    out[b, c, y, x] = total[b, 0, y, x] * image[b, c, y, x]
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
                        total[b, 0, y, left:right],
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
                    out[b, c, y, x] /= total[b, 0, y, x]


@compiled
def _gather(results: Any, pull: Any, shared: Any, inputs: Any, b: int, first: int, last: int) -> None:
    """Rows ``first`` to ``last`` of the derivatives, which are 0 before."""
    of_image, of_features, of_bandwidth, of_center, of_previous, of_there, of_width, of_weight = results
    image, features, bandwidth, center, previous, there, width_there, known = inputs[:8]
    _, channels, height, width = pull.shape
    radius, dilation = inputs.kernel_size // 2, inputs.dilation
    buffers = np.empty((4, min(width, _CHUNK)), pull.dtype)
    least = pull.dtype.type(LEAST_CENTER)
    for y in range(first, last):
        for x0 in range(0, width, _CHUNK):
            x1 = min(x0 + _CHUNK, width)
            slope = of_center[b, 0, y, x0:x1]
            _slope(slope, pull, shared, image, b, y, x0, y, x0)
            for x in range(x0, x1):
                own = center[b, 0, y, x]
                for c in range(channels):
                    of_image[b, c, y, x] = (least if own < least else own) * pull[b, c, y, x]
                if own < least:
                    of_center[b, 0, y, x] = 0
            for t in range(inputs.kernel_size**2):
                dy, dx = (t // inputs.kernel_size - radius) * dilation, (t % inputs.kernel_size - radius) * dilation
                row, left, right = y + dy, max(x0, -dx), min(x1, width - dx)
                if row < 0 or row >= height or right <= left:
                    continue
                start, end, n = left + dx, right + dx, right - left
                square, weight, slope, factor = buffers[0, :n], buffers[1, :n], buffers[2, :n], buffers[3, :n]
                if dy != 0 or dx != 0:
                    _square(square, features, features, b, y, left, row, start)
                    # The derivatives of this pixel's mean, which contains the tap.
                    _weigh(weight, square, bandwidth[b, 0, y, left:right])
                    _slope(slope, pull, shared, image, b, y, left, row, start)
                    multiply(slope, weight)
                    _subtract_product(of_bandwidth[b, 0, y, left:right], slope, square)
                    factor[:] = 0
                    add_product(factor, slope, bandwidth[b, 0, y, left:right])
                    # The derivatives of the tap's mean, which contains this pixel.
                    _weigh(weight, square, bandwidth[b, 0, row, start:end])
                    _slope(slope, pull, shared, image, b, row, start, y, left)
                    multiply(slope, weight)
                    add_product(factor, slope, bandwidth[b, 0, row, start:end])
                    for c in range(channels):
                        add_product(of_image[b, c, y, left:right], weight, pull[b, c, row, start:end])
                    _attract(of_features, factor, features, features, b, y, left, row, start)
                if previous.size > 0:
                    _square(square, features, there, b, y, left, row, start)
                    _weigh(weight, square, width_there[b, 0, y, left:right])
                    _slope(slope, pull, shared, previous, b, y, left, row, start)
                    multiply(slope, weight)
                    multiply(slope, known[b, 0, row, start:end])
                    _subtract_product(of_width[b, 0, y, left:right], slope, square)
                    multiply(slope, width_there[b, 0, y, left:right])
                    _attract(of_features, slope, features, there, b, y, left, row, start)
                    # The same of the frame before, and all but one times how much of it is known.
                    _square(square, there, features, b, y, left, row, start)
                    _weigh(weight, square, width_there[b, 0, row, start:end])
                    _slope(slope, pull, shared, previous, b, row, start, y, left)
                    multiply(slope, weight)
                    add(of_weight[b, 0, y, left:right], slope)
                    multiply(slope, width_there[b, 0, row, start:end])
                    multiply(slope, known[b, 0, y, left:right])
                    _attract(of_there, slope, there, features, b, y, left, row, start)
                    multiply(weight, known[b, 0, y, left:right])
                    for c in range(channels):
                        add_product(of_previous[b, c, y, left:right], weight, pull[b, c, row, start:end])


@compiled
def _square(total: Any, own: Any, others: Any, b: int, y: int, x: int, row: int, start: int) -> None:
    """``|own[p] - others[q]|^2`` of a run of pixels and of their taps."""
    n, count = total.size, own.shape[1]
    most = total.dtype.type(FARTHEST_FEATURE)
    total[:] = 0
    c = 0
    # Four at a time: the sum is read and stored once for them.
    while c + 4 <= count:
        a0, a1 = own[b, c, y, x : x + n], own[b, c + 1, y, x : x + n]
        a2, a3 = own[b, c + 2, y, x : x + n], own[b, c + 3, y, x : x + n]
        b0, b1 = others[b, c, row, start : start + n], others[b, c + 1, row, start : start + n]
        b2, b3 = others[b, c + 2, row, start : start + n], others[b, c + 3, row, start : start + n]
        for i in range(n):
            d0, d1, d2, d3 = a0[i] - b0[i], a1[i] - b1[i], a2[i] - b2[i], a3[i] - b3[i]
            d0, d1, d2, d3 = _near(d0, most), _near(d1, most), _near(d2, most), _near(d3, most)
            total[i] += (d0 * d0 + d1 * d1) + (d2 * d2 + d3 * d3)
        c += 4
    while c < count:
        a0, b0 = own[b, c, y, x : x + n], others[b, c, row, start : start + n]
        for i in range(n):
            d0 = _near(a0[i] - b0[i], most)
            total[i] += d0 * d0
        c += 1


@compiled
def _near(difference: Any, most: Any) -> Any:
    """Within the farthest; a NaN, which is not less or more, stays."""
    below = most if difference > most else difference
    return -most if below < -most else below


@compiled
def _weigh(weight: Any, square: Any, bandwidth: Any) -> None:
    for i in range(weight.size):
        weight[i] = exp(-(bandwidth[i] * square[i]))


@compiled
def _slope(slope: Any, pull: Any, shared: Any, image: Any, b: int, y: int, x: int, row: int, start: int) -> None:
    """The derivatives of the means of a run of pixels in the weights of their taps."""
    n = slope.size
    of_all = shared[b, 0, y, x : x + n]
    for i in range(n):
        slope[i] = -of_all[i]
    for c in range(image.shape[1]):
        add_product(slope, pull[b, c, y, x : x + n], image[b, c, row, start : start + n])


@compiled
def _attract(total: Any, factor: Any, own: Any, others: Any, b: int, y: int, x: int, row: int, start: int) -> None:
    """``-2 factor (own[p] - others[q])``."""
    n = factor.size
    most = factor.dtype.type(FARTHEST_FEATURE)
    for c in range(own.shape[1]):
        sums, a, others_row = total[b, c, y, x : x + n], own[b, c, y, x : x + n], others[b, c, row, start : start + n]
        for i in range(n):
            half = factor[i] * _near(a[i] - others_row[i], most)
            sums[i] -= half + half


@compiled
def _subtract_product(total: Any, a: Any, b: Any) -> None:
    for i in range(total.size):
        total[i] -= a[i] * b[i]
