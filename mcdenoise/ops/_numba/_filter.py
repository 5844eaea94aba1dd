"""One compiled filter for every op that weighs the taps of a window, and its derivatives.

``out[p] = sum_t w[t, p] image[p + o_t] / total[p]`` with weights as in
:func:`mcdenoise.ops.cross_bilateral_filter`; with neither guides nor a distance scale and with ``"none"`` that is
:func:`mcdenoise.ops.kernel_conv`.

Rows of all images wait in a ring as long as a window needs them, with their borders filled in and in the dtype of the
sums; kernels are read once, in whatever layout and precision they have. So no argument is copied as a whole, and the
``K*K`` weights exist for ``_CHUNK`` pixels at a time; the derivatives compute them once more. Rows are shared out among
threads of our own, as many as torch uses: numba's would be a second OpenMP beside torch's.
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
    copy_row,
    exp,
    flushing,
    load,
    multiply,
    readable,
    rounded,
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
    """The inputs of a filter; a guide or a falloff that is not given has no channels."""

    kernel: Source
    image: Source
    guides: tuple[Source, ...]
    falloffs: tuple[Source, ...]
    distance: Source
    height: int
    width: int
    kernel_size: int
    log_domain: bool
    border: int


def filtered(
    image: Tensor,
    kernel: Tensor,
    guides: Sequence[Tensor],
    falloffs: Sequence[Tensor],
    distance_falloff: Tensor | None,
    log_domain: bool,
    border: Border,
) -> Tensor:
    """The filtered image, contiguous and in the dtype of ``image``."""
    dtype = _compute_dtype(image, kernel)
    out = torch.empty(image.shape, dtype=dtype, device="cpu")
    if out.numel():
        inputs = _inputs(dtype, image, kernel, guides, falloffs, distance_falloff, log_domain, border)
        share_rows(image, lambda *rows: _forward(out.numpy(), inputs, *rows))
    return out.to(image.dtype)


def splatted(image: Tensor, kernel: Tensor, border: Border) -> Tensor:
    """The transpose of the filter without guides, which is its derivative in the image."""
    return derivatives(image, image, kernel, (), (), None, False, border, of_kernel=False)[0]


def derivatives(
    gradient: Tensor,
    image: Tensor,
    kernel: Tensor,
    guides: Sequence[Tensor],
    falloffs: Sequence[Tensor],
    distance_falloff: Tensor | None,
    log_domain: bool,
    border: Border,
    of_guides: bool = False,
    of_kernel: bool = True,
) -> tuple[Tensor, Tensor, list[Tensor], list[Tensor], Tensor]:
    """The derivatives in image, kernel, guides, falloffs and distance falloff, times ``gradient``.

    All but the first need the derivative in every weight, so without ``of_kernel`` they are empty; those in the guides
    also need ``of_guides``. Each has the dtype and shape of its input, and is empty where that is absent.
    """
    dtype = _compute_dtype(image, kernel)
    batch, _, height, width = image.shape
    of_scales = [torch.empty((batch, 1, height, width), dtype=dtype, device="cpu") for _ in falloffs]
    of_distance = torch.empty((batch, 0 if distance_falloff is None else 1, height, width), dtype=dtype, device="cpu")
    planes = [image, *(guides if of_guides else ())]
    scattered = torch.empty((batch, sum(plane.shape[1] for plane in planes), height, width), dtype=dtype, device="cpu")
    slopes = torch.empty_like(kernel if of_kernel else kernel[:, :0], dtype=readable(kernel, dtype).dtype)
    if not image.numel():
        for result in (scattered, slopes, of_distance, *of_scales):
            result.zero_()
    elif scattered.numel():
        inputs = _inputs(dtype, image, kernel, guides, falloffs, distance_falloff, log_domain, border)
        upstream = source(gradient.to(dtype))
        results = (
            scattered.numpy(),
            source(slopes),
            _filled_up([scale.numpy() for scale in of_scales], of_distance.numpy()),
            of_distance.numpy(),
        )
        flush = flushing(image, gradient)

        def run(b: int, first: int, last: int) -> None:
            with flush():
                _backward(results, upstream, inputs, b, first, last)

        share_rows(image, run)
    of_planes = torch.split(scattered, [plane.shape[1] for plane in planes], 1)
    # Custom ops hand out tensors of their own, and no views.
    of_image, *guide_gradients = (
        part.to(plane.dtype, copy=len(planes) > 1) for part, plane in zip(of_planes, planes, strict=True)
    )
    return (
        of_image,
        slopes.to(kernel.dtype),
        guide_gradients,
        [part.to(scale.dtype) for part, scale in zip(of_scales, falloffs, strict=True)],
        of_distance if distance_falloff is None else of_distance.to(distance_falloff.dtype),
    )


def _compute_dtype(image: Tensor, kernel: Tensor) -> torch.dtype:
    return accumulator_dtype(torch.promote_types(image.dtype, kernel.dtype))


def _inputs(
    dtype: torch.dtype,
    image: Tensor,
    kernel: Tensor,
    guides: Sequence[Tensor],
    falloffs: Sequence[Tensor],
    distance_falloff: Tensor | None,
    log_domain: bool,
    border: Border,
) -> _Inputs:
    nothing = source(torch.empty((0, 0, 0, 0), dtype=dtype, device="cpu"))
    return _Inputs(
        source(readable(kernel, dtype)),
        source(image.to(dtype)),
        _filled_up([source(guide.to(dtype)) for guide in guides], nothing),
        _filled_up([source(scale.to(dtype)) for scale in falloffs], nothing),
        nothing if distance_falloff is None else source(distance_falloff.to(dtype)),
        image.shape[2],
        image.shape[3],
        kernel_size_of(kernel.shape[1], "kernel"),
        log_domain,
        BORDERS.index(border),
    )


def _filled_up(values: list[Any], nothing: Any) -> tuple[Any, ...]:
    return (*values, *[nothing] * (-len(values) % _GUIDES or (0 if values else _GUIDES)))


@compiled
def _fetch(rows: Any, source: Any, b: int, y: int, height: int, radius: int, border: int) -> None:
    """Row ``y`` of each channel, which may lie beyond the image, with ``radius`` more pixels at both ends."""
    _, strides, channels = source
    width = rows.shape[1] - 2 * radius
    for c in range(channels):
        row = rows[c]
        if border != _REPLICATE and (y < 0 or y >= height):
            row[:] = 0
            continue
        nearest = min(max(y, 0), height - 1)
        inner = row[radius : radius + width]
        copy_row(inner, source, b * strides[0] + c * strides[1] + nearest * strides[2], strides[3])
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
            copy_row(taps[t, :n], kernel, start + t * strides[1], strides[3])


@compiled
def _write_taps(kernel: Any, taps: Any, b: int, y: int, x0: int, n: int) -> None:
    """The opposite of :func:`_read_taps`."""
    memory, strides, count = kernel
    start = b * strides[0] + y * strides[2] + x0 * strides[3]
    if strides[1] == 1 and strides[3] != 1:
        for x in range(n):
            values = memory[start + x * strides[3] : start + x * strides[3] + count]
            for t in range(count):
                values[t] = rounded(taps[t, x], memory)
    else:
        for t in range(count):
            for x in range(n):
                memory[start + t * strides[1] + x * strides[3]] = rounded(taps[t, x], memory)


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
    kernel, image, guides, falloffs, distance, height, width, kernel_size, log_domain, border = inputs
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
        _read_falloffs(falloff, falloffs, distance, b, y, x0, n)
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
            if distance[2] > 0:
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
            _maximum(maximum, weights[t, :n])
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
def _read_falloffs(falloff: Any, falloffs: Any, distance: Any, b: int, y: int, x0: int, n: int) -> None:
    for g in range(len(falloffs)):
        if falloffs[g][2] > 0:
            strides = falloffs[g][1]
            copy_row(falloff[g, :n], falloffs[g], b * strides[0] + y * strides[2] + x0 * strides[3], strides[3])
    if distance[2] > 0:
        strides = distance[1]
        start = b * strides[0] + y * strides[2] + x0 * strides[3]
        copy_row(falloff[len(falloffs), :n], distance, start, strides[3])


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
def _maximum(total: Any, values: Any) -> None:
    for x in range(total.size):
        total[x] = max(total[x], values[x])


@compiled
def _is_guided(inputs: Any) -> bool:
    return bool(_channels_of(inputs) > inputs.image[2] or inputs.distance[2] > 0)


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
    falloff = np.empty((len(inputs.falloffs) + 1, chunk), out.dtype)
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


@compiled
def _backward(results: Any, gradient: Any, inputs: Any, b: int, first: int, last: int) -> None:
    """Rows ``first`` to ``last`` of the derivatives.

    Pixels of the rows around spread into these rows, too: their weights are computed here once more, so that no sums
    are shared between threads.
    """
    scattered, of_kernel, of_scales, of_distance = results
    height, width, kernel_size, channels = inputs.height, inputs.width, inputs.kernel_size, inputs.image[2]
    log_domain, border = inputs.log_domain, inputs.border
    radius, taps, chunk = kernel_size // 2, kernel_size**2, min(_CHUNK, width)
    dtype = scattered.dtype
    of_guides, with_slopes = scattered.shape[1] > channels, of_kernel[2] > 0
    ring = np.zeros((kernel_size, _channels_of(inputs), width + 2 * radius), dtype)
    sums = np.zeros((kernel_size, scattered.shape[1], width + 2 * radius), dtype)
    weights, slopes = np.empty((taps, chunk), dtype), np.empty((taps, chunk), dtype)
    factors = np.empty((0 if log_domain else taps, chunk), dtype)
    falloff = np.empty((len(inputs.falloffs) + 1, chunk), dtype)
    upstream = np.empty((channels, chunk), dtype)
    inverse, maximum, total = np.empty(chunk, dtype), np.empty(chunk, dtype), np.empty(chunk, dtype)
    start_row, end_row = max(first - radius, 0), min(last + radius, height)
    normalised = log_domain or border == _RENORMALIZE
    for row in range(start_row - radius, end_row + radius):
        if with_slopes:
            _fetch_all(ring, inputs, b, row)
        y = row - radius
        if y < start_row:
            continue
        mine = first <= y < last
        for x0 in range(0, width, chunk):
            n = min(chunk, width - x0)
            scale, shared = inverse[:n], total[:n]
            _weigh(weights, factors, scale, ring, falloff, maximum[:n], inputs, b, y, x0, n)
            strides = gradient[1]
            for c in range(channels):
                start = b * strides[0] + c * strides[1] + y * strides[2] + x0 * strides[3]
                copy_row(upstream[c, :n], gradient, start, strides[3])
                multiply(upstream[c, :n], scale)
            # The slope of each weight; where weights are normalised, minus the mean slope, which all of them share.
            shared[:] = 0
            for t in range(taps if with_slopes else 0):
                start = x0 + t % kernel_size
                neighbours = ring[(y + t // kernel_size - radius) % kernel_size]
                slopes[t, :n] = 0
                for c in range(channels):
                    add_product(slopes[t, :n], upstream[c, :n], neighbours[c, start : start + n])
                if normalised:
                    add_product(shared, weights[t, :n], slopes[t, :n])
            if normalised:
                multiply(shared, scale)
            for t in range(taps):
                target = y + t // kernel_size - radius
                if border == _REPLICATE:
                    target = min(max(target, 0), height - 1)
                start = x0 + t % kernel_size
                # No row but ours, and none beyond the image.
                if first <= target < last:
                    for c in range(channels):
                        add_product(sums[target % kernel_size, c, start : start + n], weights[t, :n], upstream[c, :n])
                if not with_slopes:
                    continue
                slope, weight = slopes[t, :n], weights[t, :n]
                if normalised:
                    for x in range(n):
                        slope[x] -= shared[x]
                if log_domain:
                    multiply(slope, weight)
                else:
                    # The exponent's slope takes the weight's place.
                    multiply(weight, slope)
                    multiply(slope, factors[t, :n])
            if not with_slopes:
                continue
            if mine:
                _write_taps(of_kernel, slopes, b, y, x0, n)
            exponents = slopes if log_domain else weights
            if mine:
                _scale_slopes(of_scales, of_distance, exponents, ring, inputs, b, y, x0, n)
            if of_guides:
                _guide_slopes(sums, exponents, falloff, maximum[:n], ring, inputs, y, x0, n, first, last)
        done = y - radius
        if first <= done < last:
            _finish(scattered, sums, b, done, radius, border)
    for done in range(max(end_row - radius, first), last):
        _finish(scattered, sums, b, done, radius, border)


@compiled
def _scale_slopes(
    of_scales: Any,
    of_distance: Any,
    slopes: Any,
    ring: Any,
    inputs: Any,
    b: int,
    y: int,
    x0: int,
    n: int,
) -> None:
    """``-sum_t slope_t |difference_t|^2`` for each guide, and with the offsets for the distance."""
    taps = slopes.shape[0]
    guides, falloffs, kernel_size = inputs.guides, inputs.falloffs, inputs.kernel_size
    radius, channel = kernel_size // 2, inputs.image[2]
    for g in range(len(guides)):
        end = channel + guides[g][2]
        if falloffs[g][2] > 0:
            result = of_scales[g][b, 0, y, x0 : x0 + n]
            result[:] = 0
            centres = ring[y % kernel_size, channel:end]
            for t in range(taps):
                neighbours = ring[(y + t // kernel_size - radius) % kernel_size, channel:end]
                _subtract_differences(result, slopes[t, :n], neighbours, centres, t % kernel_size - radius, x0 + radius)
        channel = end
    if of_distance.shape[1] > 0:
        result = of_distance[b, 0, y, x0 : x0 + n]
        result[:] = 0
        for t in range(taps):
            dy, dx = t // kernel_size - radius, t % kernel_size - radius
            _subtract_multiple(result, slopes[t, :n], dy * dy + dx * dx)


@compiled
def _guide_slopes(
    sums: Any,
    slopes: Any,
    falloff: Any,
    pull: Any,
    ring: Any,
    inputs: Any,
    y: int,
    x0: int,
    n: int,
    first: int,
    last: int,
) -> None:
    """Each tap pulls the neighbour one way and the centre the other."""
    taps = slopes.shape[0]
    guides, kernel_size = inputs.guides, inputs.kernel_size
    radius = kernel_size // 2
    begin = x0 + radius
    for t in range(taps):
        row, dx = y + t // kernel_size - radius, t % kernel_size - radius
        target = min(max(row, 0), inputs.height - 1) if inputs.border == _REPLICATE else row
        channel = inputs.image[2]
        for g in range(len(guides)):
            for c in range(channel, channel + guides[g][2]):
                slope, factor = slopes[t, :n], falloff[g, :n]
                neighbour = ring[row % kernel_size, c, begin + dx : begin + dx + n]
                centre = ring[y % kernel_size, c, begin : begin + n]
                for x in range(n):
                    half = slope[x] * factor[x] * (neighbour[x] - centre[x])
                    pull[x] = half + half
                if first <= target < last:
                    there = sums[target % kernel_size, c, begin + dx : begin + dx + n]
                    for x in range(n):
                        there[x] -= pull[x]
                if first <= y < last:
                    add(sums[y % kernel_size, c, begin : begin + n], pull)
            channel += guides[g][2]


@compiled
def _finish(scattered: Any, sums: Any, b: int, y: int, radius: int, border: int) -> None:
    """Hand out a row that no further pixel adds to, and clear its place."""
    width = scattered.shape[3]
    for c in range(scattered.shape[1]):
        row = sums[y % sums.shape[0], c]
        out = scattered[b, c, y]
        out[:] = row[radius : radius + width]
        if border == _REPLICATE:
            for i in range(radius):
                out[0] += row[i]
                out[width - 1] += row[radius + width + i]
        row[:] = 0
