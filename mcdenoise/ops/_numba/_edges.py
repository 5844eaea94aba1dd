"""Averages over windows that stop at edges, as a torch operator with derivatives.

The kernels go row by row and tap by tap over a run of pixels, whose weights stay in the first-level cache. All
edge-stopping functions are exponentials, so that one exponential of the sum of their exponents gives the weight of a
tap. Derivatives are gathered: each pixel adds up its own contributions as a tap of other pixels, so that no thread
writes to another one's rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mcdenoise.ops._constants import DEPTH_EPSILON, HIGHEST_QUOTIENT, LEAST_DEPTH
from mcdenoise.ops._numba._runtime import add, add_product, compiled, exp, flushing, log, multiply, share_rows
from mcdenoise.ops._operator import custom_op

_CHUNK = 512
_ARGUMENTS = (
    "Tensor image, Tensor noise, Tensor? normal, Tensor? depth, Tensor? bright, Tensor? deviation, "
    "float[] kernel, int step, float sigma_z, float sigma_n"
)


class _Inputs(NamedTuple):
    """Arrays ``(B, C, H, W)``, of no channels where there is nothing, and settings, all in the dtype of the sums."""

    image: Any
    noise: Any
    normal: Any
    depth: Any
    bright: Any
    deviation: Any
    kernel: Any
    sigmas: Any
    step: int
    slope: Any


@custom_op("mcdenoise::edge_average", device_types="cpu", schema=f"({_ARGUMENTS}) -> (Tensor, Tensor)")
def average(*arguments: Any) -> tuple[Tensor, Tensor]:
    """See :func:`mcdenoise.ops._edges.average`."""
    mean, variance, _ = _averaged(_inputs(*arguments))
    return mean, variance


@average.register_fake
def _(image: Tensor, noise: Tensor, *_: Any) -> tuple[Tensor, Tensor]:
    return image.new_empty(image.shape), noise.new_empty(noise.shape)


def average_gradients(
    needed: Sequence[Any], of_mean: Tensor, of_variance: Tensor, *arguments: Any
) -> tuple[Tensor | None, ...]:
    """The derivatives in each argument, times the gradients of both results."""
    found = iter(_backward(of_mean, of_variance, *arguments))
    return tuple(next(found) if isinstance(each, Tensor) else None for each in arguments)


average_gradients.of_all = True  # type: ignore[attr-defined]


@custom_op(
    "mcdenoise::edge_average_backward",
    device_types="cpu",
    schema=f"(Tensor of_mean, Tensor of_variance, {_ARGUMENTS}) -> Tensor[]",
)
def _backward(of_mean: Tensor, of_variance: Tensor, *arguments: Any) -> list[Tensor]:
    """The derivatives in each tensor among the arguments."""
    inputs, tensors = _inputs(*arguments), [each for each in arguments if isinstance(each, Tensor)]
    results = [torch.zeros(each.shape, dtype=of_mean.dtype, device="cpu") for each in inputs[:6]]
    if of_mean.numel():
        mean, variance, total = _averaged(inputs)
        given = (of_mean / total).contiguous(), (2 * of_variance / total.square()).contiguous()
        arrays = tuple(each.numpy() for each in (*given, mean, variance * total))
        of_slope = np.zeros_like(inputs.slope)
        found, flush = (*(each.numpy() for each in results), of_slope), flushing(of_mean, arguments[0])

        def run(b: int, first: int, last: int) -> None:
            with flush():
                _gather(found, arrays, inputs, b, first, last)

        share_rows(of_mean, run)
        if of_slope.size:
            share_rows(of_mean, lambda *rows: _gather_slopes(found[3], of_slope, inputs.depth, *rows))
    there = [isinstance(each, Tensor) for each in arguments[:6]]
    kept = [each for each, own in zip(results, there, strict=True) if own]
    return [each.to(tensor.dtype) for each, tensor in zip(kept, tensors, strict=True)]


@_backward.register_fake
def _(of_mean: Tensor, of_variance: Tensor, *arguments: Any) -> list[Tensor]:
    return [each.new_empty(each.shape) for each in arguments if isinstance(each, Tensor)]


def _inputs(*arguments: Any) -> _Inputs:
    image, *_, kernel, step, sigma_z, sigma_n = arguments
    nothing = image.new_empty((len(image), 0, *image.shape[2:]))
    arrays = [(nothing if each is None else each.detach().contiguous()).numpy() for each in arguments[:6]]
    settings = (image.new_tensor(each).numpy() for each in (kernel, (sigma_z, sigma_n)))
    depth = arrays[3]
    slope = np.empty((len(depth), 2 * depth.shape[1], *depth.shape[2:]), depth.dtype)
    if slope.size:
        share_rows(image, lambda *rows: _find_slopes(slope, depth, *rows))
    return _Inputs._make([*arrays, *settings, step, slope])


def _averaged(inputs: _Inputs) -> tuple[Tensor, Tensor, Tensor]:
    """Means, their variances, and the sum of the weights of each pixel."""
    batch, _, height, width = inputs.image.shape
    results = [torch.from_numpy(np.empty_like(each)) for each in (inputs.image, inputs.noise)]
    results.append(results[0].new_empty((batch, 1, height, width)))
    if results[0].numel():
        arrays = tuple(each.numpy() for each in results)
        share_rows(results[0], lambda *rows: _average(*arrays, inputs, *rows))
    return results[0], results[1], results[2]


@compiled
def _average(mean: Any, variance: Any, total: Any, inputs: Any, b: int, first: int, last: int) -> None:
    """Rows ``first`` to ``last`` of the result."""
    _, _, height, width = mean.shape
    size, step, image, noise = inputs.kernel.size, inputs.step, inputs.image, inputs.noise
    buffer = np.empty(min(width, _CHUNK), mean.dtype)
    for y in range(first, last):
        for x0 in range(0, width, _CHUNK):
            x1 = min(x0 + _CHUNK, width)
            mean[b, :, y, x0:x1], variance[b, :, y, x0:x1], total[b, 0, y, x0:x1] = 0, 0, 0
            for t in range(size * size):
                dy, dx = (t // size - size // 2) * step, (t % size - size // 2) * step
                row, left, right = y + dy, max(x0, -dx), min(x1, width - dx)
                if row < 0 or row >= height or right <= left:
                    continue
                start, end, weight = left + dx, right + dx, buffer[: right - left]
                _weigh(weight, inputs, t, b, y, left, row, start)
                add(total[b, 0, y, left:right], weight)
                for c in range(image.shape[1]):
                    add_product(mean[b, c, y, left:right], weight, image[b, c, row, start:end])
                for c in range(noise.shape[1]):
                    _add_square(variance[b, c, y, left:right], weight, noise[b, c, row, start:end])
            _divide(mean[b, :, y, x0:x1], variance[b, :, y, x0:x1], total[b, 0, y, x0:x1])


@compiled
def _find_slopes(slope: Any, depth: Any, b: int, first: int, last: int) -> None:
    """Rows ``first`` to ``last`` of the slopes along x and y."""
    _, _, height, width = depth.shape
    # Three rows with a missing pixel at both ends; beyond the image all are missing.
    rows = np.full((3, width + 2), np.inf, depth.dtype)
    for y in range(first, last):
        for k in range(3):
            if 0 <= y + k - 1 < height:
                rows[k, 1 : width + 1] = depth[b, 0, y + k - 1]
            else:
                rows[k] = np.inf
        along, across = slope[b, 0, y], slope[b, 1, y]
        above, here, below = rows[0], rows[1], rows[2]
        for x in range(width):
            along[x] = _smaller(here[x + 1] - here[x], here[x + 2] - here[x + 1])
            across[x] = _smaller(here[x + 1] - above[x + 1], below[x + 1] - here[x + 1])


@compiled
def _smaller(backward: Any, forward: Any) -> Any:
    """The smaller of two differences, of which one to a missing pixel is no finite number; 0 where both are missing."""
    zero = type(backward)(0)
    has_backward, has_forward = backward - backward == zero, forward - forward == zero
    takes_forward = has_forward and (not has_backward or abs(forward) < abs(backward))
    return forward if takes_forward else backward if has_backward else zero


@compiled
def _gather_slopes(of_depth: Any, of_slope: Any, depth: Any, b: int, first: int, last: int) -> None:
    """Add the gradient of the slopes, which are differences of depths, to the depths of rows ``first`` to ``last``."""
    _, _, height, width = depth.shape
    for axis in range(2):
        dy, dx = axis, 1 - axis
        for y in range(first, last):
            for x in range(width):
                # A difference belongs to the slopes of both its pixels.
                for end in range(2):
                    top, left = y - end * dy, x - end * dx
                    low, right = top + dy, left + dx
                    if top < 0 or left < 0 or low >= height or right >= width:
                        continue
                    step = depth[b, 0, low, right] - depth[b, 0, top, left]
                    gained = of_depth.dtype.type(0)
                    if _is_forward(depth, b, top, left, dy, dx):
                        gained += of_slope[b, axis, top, left]
                    if not _is_forward(depth, b, low, right, dy, dx):
                        gained += of_slope[b, axis, low, right]
                    if step - step == 0:
                        of_depth[b, 0, y, x] += gained if end else -gained


@compiled
def _is_forward(depth: Any, b: int, y: int, x: int, dy: int, dx: int) -> Any:
    """Whether the slope of a pixel is the difference to the next one, if it is any."""
    _, _, height, width = depth.shape
    own, missing = depth[b, 0, y, x], depth.dtype.type(np.inf)
    backward, forward = missing, missing
    if y >= dy and x >= dx:
        backward = own - depth[b, 0, y - dy, x - dx]
    if y + dy < height and x + dx < width:
        forward = depth[b, 0, y + dy, x + dx] - own
    if forward - forward != 0:
        return False
    return backward - backward != 0 or abs(forward) < abs(backward)


@compiled
def _divide(mean: Any, variance: Any, total: Any) -> None:
    for x in range(total.size):
        inverse = total.dtype.type(1) / total[x]
        for c in range(mean.shape[0]):
            mean[c, x] *= inverse
        for c in range(variance.shape[0]):
            variance[c, x] *= inverse * inverse


@compiled
def _add_square(total: Any, weight: Any, values: Any) -> None:
    for x in range(total.size):
        total[x] += weight[x] * weight[x] * values[x]


@compiled
def _weigh(weight: Any, inputs: Any, t: int, b: int, y: int, x: int, row: int, start: int) -> None:
    """Weights of the taps from ``(row, start)`` on, the one of number ``t`` each of the pixels from ``(y, x)`` on."""
    n, number = weight.size, weight.dtype.type
    size, most, zero, one, half = inputs.kernel.size, number(HIGHEST_QUOTIENT), number(0), number(1), number(0.5)
    normal, least = inputs.normal, number(-np.inf)
    weight[:] = zero
    if inputs.bright.shape[1]:
        own, others = inputs.bright[b, 0, y, x : x + n], inputs.bright[b, 0, row, start : start + n]
        tolerance = inputs.deviation[b, 0, y, x : x + n]
        for i in range(n):
            quotient = abs(others[i] - own[i]) / tolerance[i]
            weight[i] = -(most if quotient > most else quotient)
    if inputs.depth.shape[1]:
        own, others = inputs.depth[b, 0, y, x : x + n], inputs.depth[b, 0, row, start : start + n]
        slope_x, slope_y = inputs.slope[b, 0, y, x : x + n], inputs.slope[b, 1, y, x : x + n]
        sigma, dx, dy = inputs.sigmas[0], number(start - x), number(row - y)
        for i in range(n):
            near, hit = own[i] - own[i] == zero, others[i] - others[i] == zero
            quotient = abs(others[i] - own[i]) / _tolerance(own[i], slope_x[i], slope_y[i], dx, dy, sigma)
            exponent = -(most if quotient > most else quotient) if near else zero
            weight[i] += exponent if near == hit else least
    if normal.shape[1]:
        nx, ny, nz = normal[b, 0, y, x : x + n], normal[b, 1, y, x : x + n], normal[b, 2, y, x : x + n]
        tx, ty = normal[b, 0, row, start : start + n], normal[b, 1, row, start : start + n]
        tz, sigma = normal[b, 2, row, start : start + n], inputs.sigmas[1]
        for i in range(n):
            u, v, w = tx[i] - nx[i], ty[i] - ny[i], tz[i] - nz[i]
            turn = half * (u * u + v * v + w * w)
            cosine = one - turn
            # The second term is the rounding error of the difference, which the exponent multiplies.
            logarithm = log(cosine) + ((one - cosine) - turn) * (one + turn)
            weight[i] += least if cosine <= zero else sigma * logarithm
    factor = inputs.kernel[t // size] * inputs.kernel[t % size]
    for i in range(n):
        weight[i] = factor * exp(weight[i])


@compiled
def _tolerance(depth: Any, slope_x: Any, slope_y: Any, dx: Any, dy: Any, sigma: Any) -> Any:
    number = type(depth)
    return sigma * abs(slope_x * dx + slope_y * dy) + (number(DEPTH_EPSILON) * depth + number(LEAST_DEPTH))


@compiled
def _gather(results: Any, given: Any, inputs: Any, b: int, first: int, last: int) -> None:
    """Rows ``first`` to ``last`` of the derivatives, which are 0 before."""
    of_image, of_noise = results[0], results[1]
    pull, pull_noise = given[0], given[1]
    _, channels, height, width = of_image.shape
    size, step = inputs.kernel.size, inputs.step
    buffers = np.empty((2, min(width, _CHUNK)), of_image.dtype)
    half = of_image.dtype.type(0.5)
    for y in range(first, last):
        for x0 in range(0, width, _CHUNK):
            x1 = min(x0 + _CHUNK, width)
            for t in range(size * size):
                dy, dx = (t // size - size // 2) * step, (t % size - size // 2) * step
                row, left, right = y + dy, max(x0, -dx), min(x1, width - dx)
                if row < 0 or row >= height or right <= left:
                    continue
                start, n = left + dx, right - left
                weight, slope = buffers[0, :n], buffers[1, :n]
                # The gradient of this pixel as the one in the middle.
                _weigh(weight, inputs, t, b, y, left, row, start)
                _slope(slope, weight, given, inputs, b, y, left, row, start)
                _of_exponents(results, slope, inputs, b, y, left, row, start, True)
                # Its gradient as a tap of the other one.
                _weigh(weight, inputs, size * size - 1 - t, b, row, start, y, left)
                for c in range(channels):
                    add_product(of_image[b, c, y, left:right], weight, pull[b, c, row, start : start + n])
                _slope(slope, weight, given, inputs, b, row, start, y, left)
                _of_exponents(results, slope, inputs, b, row, start, y, left, False)
                for i in range(n):
                    weight[i] *= half * weight[i]
                for c in range(of_noise.shape[1]):
                    add_product(of_noise[b, c, y, left:right], weight, pull_noise[b, c, row, start : start + n])


@compiled
def _slope(slope: Any, weight: Any, given: Any, inputs: Any, b: int, y: int, x: int, row: int, start: int) -> None:
    """The derivative of the results in the exponents of a run of taps."""
    n = slope.size
    pull, pull_noise, mean, variance = given
    slope[:] = 0
    for c in range(mean.shape[1]):
        factor, own = pull[b, c, y, x : x + n], mean[b, c, y, x : x + n]
        others = inputs.image[b, c, row, start : start + n]
        for i in range(n):
            slope[i] += factor[i] * (others[i] - own[i])
    for c in range(variance.shape[1]):
        factor, own = pull_noise[b, c, y, x : x + n], variance[b, c, y, x : x + n]
        others = inputs.noise[b, c, row, start : start + n]
        for i in range(n):
            slope[i] += factor[i] * (weight[i] * others[i] - own[i])
    multiply(slope, weight)


@compiled
def _of_exponents(
    results: Any, slope: Any, inputs: Any, b: int, y: int, x: int, row: int, start: int, middle: bool
) -> None:
    """Add the slopes of exponents to the gradients of the pixels in the middle, from ``(y, x)`` on, or of the taps."""
    _, _, of_normal, of_depth, of_bright, of_deviation, of_slope = results
    n, number = slope.size, slope.dtype.type
    zero, one, half = number(0), number(1), number(0.5)
    into, at = (y, x) if middle else (row, start)
    sign = one if middle else -one
    if of_bright.shape[1]:
        own, others = inputs.bright[b, 0, y, x : x + n], inputs.bright[b, 0, row, start : start + n]
        tolerance, found = inputs.deviation[b, 0, y, x : x + n], of_bright[b, 0, into, at : at + n]
        of_tolerance = of_deviation[b, 0, into, at : at + n]
        for i in range(n):
            difference, pull = others[i] - own[i], slope[i] / tolerance[i]
            found[i] += sign * (pull if difference > zero else -pull if difference < zero else zero)
            if middle:
                of_tolerance[i] += pull * (abs(difference) / tolerance[i]) if slope[i] != zero else zero
    if of_depth.shape[1]:
        own, others = inputs.depth[b, 0, y, x : x + n], inputs.depth[b, 0, row, start : start + n]
        slope_x, slope_y = inputs.slope[b, 0, y, x : x + n], inputs.slope[b, 1, y, x : x + n]
        found, of_x = of_depth[b, 0, into, at : at + n], of_slope[b, 0, into, at : at + n]
        of_y = of_slope[b, 1, into, at : at + n]
        sigma, dx, dy = inputs.sigmas[0], number(start - x), number(row - y)
        for i in range(n):
            near = own[i] - own[i] == zero and slope[i] != zero
            tolerance = _tolerance(own[i], slope_x[i], slope_y[i], dx, dy, sigma)
            difference, pull = others[i] - own[i], slope[i] / tolerance
            gained = sign * (pull if difference > zero else -pull if difference < zero else zero)
            if middle:
                stretched = pull * (abs(difference) / tolerance)
                gained += number(DEPTH_EPSILON) * stretched
                rise = slope_x[i] * dx + slope_y[i] * dy
                turned = sigma * (stretched if rise > zero else -stretched if rise < zero else zero)
                of_x[i] += turned * dx if near else zero
                of_y[i] += turned * dy if near else zero
            found[i] += gained if near else zero
    if of_normal.shape[1]:
        nx, ny, nz = (
            inputs.normal[b, 0, y, x : x + n],
            inputs.normal[b, 1, y, x : x + n],
            inputs.normal[b, 2, y, x : x + n],
        )
        tx, ty = inputs.normal[b, 0, row, start : start + n], inputs.normal[b, 1, row, start : start + n]
        tz, sigma = inputs.normal[b, 2, row, start : start + n], inputs.sigmas[1]
        found_x, found_y = of_normal[b, 0, into, at : at + n], of_normal[b, 1, into, at : at + n]
        found_z = of_normal[b, 2, into, at : at + n]
        for i in range(n):
            u, v, w = tx[i] - nx[i], ty[i] - ny[i], tz[i] - nz[i]
            cosine = one - half * (u * u + v * v + w * w)
            factor = zero if cosine <= zero else sign * sigma * slope[i] / cosine
            found_x[i] += factor * u
            found_y[i] += factor * v
            found_z[i] += factor * w
