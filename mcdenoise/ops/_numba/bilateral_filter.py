"""One compiled filter for the ops that weigh the taps of a window.

``out[p] = sum_t w[t, p] image[p + o_t] / total[p]`` with weights as in
:func:`mcdenoise.ops.cross_bilateral_filter`; with neither guides nor a distance scale and with ``"none"`` that is
:func:`mcdenoise.ops.kernel_conv`.

Rows of all images wait in a ring as long as a window needs them, with their borders filled in and in the dtype of the
sums; kernels are read once, in whatever layout and precision they have. So no argument is copied as a whole, and the
``K*K`` weights exist for ``_CHUNK`` pixels at a time. Rows are shared out among threads of our own, as many as torch
uses: numba's would be a second OpenMP beside torch's.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mcdenoise.ops._numba._runtime import (
    Source,
    add,
    add_product,
    compiled,
    exp,
    larger,
    load,
    multiply,
    read_row,
    readable,
    share_rows,
    source,
)
from mcdenoise.ops._window import BORDERS, Border, accumulator_dtype, kernel_size_of

# Pixels whose weights are held at a time: 25 taps of 256 floats stay in the first-level cache.
_CHUNK = 256

# Guides come in tuples of this length or a multiple of it, filled up with empty ones: each length is compiled anew.
_GUIDES = 4

_REPLICATE, _ZEROS, _RENORMALIZE = range(len(BORDERS))


class _Inputs(NamedTuple):
    """Inputs of a filter: what is not given has no channels, and the last falloff is that of the distance."""

    kernel: Source
    image: Source
    guides: tuple[Source, ...]
    falloffs: tuple[Source, ...]
    height: int
    width: int
    kernel_size: int
    log_domain: bool
    border: int


def cross_bilateral_filter(
    image: Tensor,
    kernel: Tensor,
    guides: Sequence[Tensor],
    falloffs: Sequence[Tensor],
    distance_falloff: Tensor | None,
    normalize: str,
    border: Border,
) -> Tensor:
    """See :func:`mcdenoise.ops.cross_bilateral_filter`."""
    dtype = accumulator_dtype(torch.promote_types(image.dtype, kernel.dtype))
    out = torch.empty(image.shape, dtype=dtype, device="cpu")
    if out.numel():
        nothing = source(torch.empty((0, 0, 0, 0), dtype=dtype, device="cpu"))
        distance = nothing if distance_falloff is None else source(distance_falloff.to(dtype))
        inputs = _Inputs(
            source(readable(kernel, dtype)),
            source(image.to(dtype)),
            _filled_up([source(guide.to(dtype)) for guide in guides], nothing),
            (*_filled_up([source(scale.to(dtype)) for scale in falloffs], nothing), distance),
            image.shape[2],
            image.shape[3],
            kernel_size_of(kernel.shape[1], "kernel"),
            normalize == "softmax",
            BORDERS.index(border),
        )
        share_rows(image, lambda *rows: _forward(out.numpy(), inputs, *rows))
    return out.to(image.dtype)


def _filled_up(values: list[Any], nothing: Any) -> tuple[Any, ...]:
    return (*values, *[nothing] * (-len(values) % _GUIDES or (0 if values else _GUIDES)))


@compiled
def _fetch(rows: Any, source: Any, b: int, y: int, height: int, radius: int, border: int) -> None:
    """Row ``y`` of each channel, which may lie beyond the image, with ``radius`` more pixels at both ends."""
    width = rows.shape[1] - 2 * radius
    for c in range(source[2]):
        row = rows[c]
        if border != _REPLICATE and (y < 0 or y >= height):
            row[:] = 0
            continue
        inner = row[radius : radius + width]
        read_row(inner, source, b, c, min(max(y, 0), height - 1), 0)
        if border == _REPLICATE:
            row[:radius] = inner[0]
            row[radius + width :] = inner[width - 1]


@compiled
def _fetch_all(ring: Any, inputs: Any, b: int, y: int) -> None:
    """The image and behind it the guides."""
    rows, radius, border = ring[y % inputs.kernel_size], inputs.kernel_size // 2, inputs.border
    _fetch(rows, inputs.image, b, y, inputs.height, radius, border)
    channel = inputs.image[2]
    for guide in inputs.guides:
        _fetch(rows[channel:], guide, b, y, inputs.height, radius, border)
        channel += guide[2]


@compiled
def _read_taps(taps: Any, kernel: Any, b: int, y: int, x0: int, n: int) -> None:
    """The kernels of a run of pixels, one row a tap, from planes or from pixels with their taps side by side."""
    memory, strides, count = kernel
    start = b * strides[0] + y * strides[2] + x0 * strides[3]
    if strides[1] == 1 and strides[3] != 1:
        for x in range(n):
            values = memory[start + x * strides[3] : start + x * strides[3] + count]
            for t in range(count):
                taps[t, x] = load(values[t])
    else:
        for t in range(count):
            read_row(taps[t, :n], kernel, b, t, y, x0)


@compiled
def _subtract_differences(total: Any, factor: Any, neighbours: Any, centres: Any, dx: int, begin: int) -> None:
    """``factor`` times the squared difference of a run of pixels and those ``dx`` to the right, over all channels."""
    n = total.size
    for c in range(centres.shape[0]):
        centre, neighbour = centres[c, begin : begin + n], neighbours[c, begin + dx : begin + dx + n]
        for x in range(n):
            difference = neighbour[x] - centre[x]
            total[x] -= factor[x] * difference * difference


@compiled
def _subtract_multiple(total: Any, values: Any, factor: int) -> None:
    # A whole number would make the products float64.
    scale = total.dtype.type(factor)
    for x in range(total.size):
        total[x] -= scale * values[x]


@compiled
def _weigh(
    weights: Any,
    factors: Any,
    inverse: Any,
    ring: Any,
    falloff: Any,
    maximum: Any,
    inputs: Any,
    b: int,
    y: int,
    x0: int,
    n: int,
) -> None:
    """Compute the weights of a run of pixels before normalisation, their factors, and the inverse of their sum.

    Where the weights are the kernel, nothing is multiplied, and ``factors`` may have no rows.
    """
    kernel, image, guides, falloffs, height, width, kernel_size, log_domain, border = inputs
    radius = kernel_size // 2
    taps = weights.shape[0]
    guided = _is_guided(inputs)
    adjusted = guided or border == _RENORMALIZE
    _read_taps(weights, kernel, b, y, x0, n)
    exponents = weights if log_domain else factors
    if log_domain:
        for t in range(taps):
            _make_finite(weights[t, :n])
    else:
        factors[:, :n] = 0 if adjusted else 1
    if guided:
        for g in range(len(falloffs)):
            if falloffs[g][2] > 0:
                read_row(falloff[g, :n], falloffs[g], b, 0, y, x0)
        centres = ring[y % kernel_size]
        for t in range(taps):
            dy, dx = t // kernel_size - radius, t % kernel_size - radius
            exponent = exponents[t, :n]
            neighbours = ring[(y + dy) % kernel_size]
            channel = image[2]
            for g in range(len(guides)):
                end = channel + guides[g][2]
                if dy != 0 or dx != 0:
                    _subtract_differences(
                        exponent, falloff[g, :n], neighbours[channel:end], centres[channel:end], dx, x0 + radius
                    )
                channel = end
            if falloffs[len(guides)][2] > 0:
                _subtract_multiple(exponent, falloff[len(guides), :n], dy * dy + dx * dx)
    if border == _RENORMALIZE:
        for t in range(taps):
            row, dx = y + t // kernel_size - radius, t % kernel_size - radius
            outside = row < 0 or row >= height
            first = n if outside else min(max(-dx - x0, 0), n)
            last = n if outside else min(max(width - dx - x0, 0), n)
            for start, stop in ((0, first), (last, n)):
                exponents[t, start:stop] = -np.inf
                if not log_domain:
                    # An infinite weight times nothing is NaN.
                    weights[t, start:stop] = 0
    if log_domain:
        maximum[:] = weights[0, :n]
        for t in range(1, taps):
            larger(maximum, weights[t, :n])
        inverse[:] = 0
        for t in range(taps):
            _exponential(weights[t, :n], maximum)
            add(inverse, weights[t, :n])
    else:
        maximum[:] = 0
        inverse[:] = 0 if border == _RENORMALIZE else 1
        for t in range(taps if adjusted else 0):
            _exponential(factors[t, :n], maximum)
            multiply(weights[t, :n], factors[t, :n])
            if border == _RENORMALIZE:
                add(inverse, weights[t, :n])
    # A plain 1 would make this a division in float64.
    one, zero = inverse.dtype.type(1), inverse.dtype.type(0)
    for x in range(n):
        inverse[x] = one / inverse[x] if inverse[x] != zero else zero


@compiled
def _exponential(values: Any, offset: Any) -> None:
    for x in range(values.size):
        values[x] = exp(values[x] - offset[x])


@compiled
def _make_finite(values: Any) -> None:
    """Infinity as the largest number: the weight of each of two infinite logits is not NaN, but half."""
    largest = np.finfo(values.dtype).max
    for x in range(values.size):
        values[x] = min(max(values[x], -largest), largest)


@compiled
def _is_guided(inputs: Any) -> bool:
    return bool(_channels_of(inputs) > inputs.image[2] or inputs.falloffs[len(inputs.guides)][2] > 0)


@compiled
def _channels_of(inputs: Any) -> int:
    """The number of channels of the image and all guides."""
    count: int = inputs.image[2]
    for guide in inputs.guides:
        count += guide[2]
    return count


@compiled
def _forward(out: Any, inputs: Any, b: int, first: int, last: int) -> None:
    """Rows ``first`` to ``last`` of the result."""
    width, kernel_size, channels, log_domain = inputs.width, inputs.kernel_size, inputs.image[2], inputs.log_domain
    radius, taps, chunk = kernel_size // 2, kernel_size**2, min(_CHUNK, width)
    ring = np.zeros((kernel_size, _channels_of(inputs), width + 2 * radius), out.dtype)
    weights = np.empty((taps, chunk), out.dtype)
    adjusted = _is_guided(inputs) or inputs.border == _RENORMALIZE
    factors = np.empty((taps if adjusted and not log_domain else 0, chunk), out.dtype)
    falloff = np.empty((len(inputs.falloffs), chunk), out.dtype)
    inverse, maximum = np.empty(chunk, out.dtype), np.empty(chunk, out.dtype)
    for row in range(first - radius, last + radius):
        _fetch_all(ring, inputs, b, row)
        y = row - radius
        if y < first:
            continue
        for x0 in range(0, width, chunk):
            n = min(chunk, width - x0)
            _weigh(weights, factors, inverse[:n], ring, falloff, maximum[:n], inputs, b, y, x0, n)
            out[b, :, y, x0 : x0 + n] = 0
            for t in range(taps):
                start = x0 + t % kernel_size
                neighbours = ring[(y + t // kernel_size - radius) % kernel_size]
                for c in range(channels):
                    add_product(out[b, c, y, x0 : x0 + n], weights[t, :n], neighbours[c, start : start + n])
            for c in range(channels):
                multiply(out[b, c, y, x0 : x0 + n], inverse[:n])
