"""Averages over windows that stop at edges.

The kernels go row by row and tap by tap over a run of pixels, whose weights stay in the first-level cache. All
edge-stopping functions are exponentials, so that one exponential of the sum of their exponents gives the weight of a
tap.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mcdenoise.ops._constants import DEPTH_EPSILON, HIGHEST_QUOTIENT, LEAST_DEPTH
from mcdenoise.ops._numba._runtime import add, add_product, compiled, exp, log, share_rows

_CHUNK = 512


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


def edge_average(*arguments: Any) -> tuple[Tensor, Tensor]:
    """See :func:`mcdenoise.ops._edges.edge_average`."""
    image, *_, kernel, step, sigma_z, sigma_n = arguments
    nothing = image.new_empty((len(image), 0, *image.shape[2:]))
    arrays = [
        (nothing if each is None else each.detach().to(image.dtype).contiguous()).numpy() for each in arguments[:6]
    ]
    settings = (image.new_tensor(each).numpy() for each in (kernel, (sigma_z, sigma_n)))
    depth = arrays[3]
    slope = np.empty((len(depth), 2 * depth.shape[1], *depth.shape[2:]), depth.dtype)
    if slope.size:
        share_rows(image, lambda *rows: _find_slopes(slope, depth, *rows))
    inputs = _Inputs._make([*arrays, *settings, step, slope])
    mean, variance = np.empty_like(inputs.image), np.empty_like(inputs.noise)
    if mean.size:
        share_rows(image, lambda *rows: _average(mean, variance, inputs, *rows))
    return torch.from_numpy(mean), torch.from_numpy(variance)


@compiled
def _average(mean: Any, variance: Any, inputs: Any, b: int, first: int, last: int) -> None:
    """Rows ``first`` to ``last`` of the result."""
    _, _, height, width = mean.shape
    size, step, image, noise = inputs.kernel.size, inputs.step, inputs.image, inputs.noise
    buffer, totals = np.empty(min(width, _CHUNK), mean.dtype), np.empty(min(width, _CHUNK), mean.dtype)
    for y in range(first, last):
        for x0 in range(0, width, _CHUNK):
            x1 = min(x0 + _CHUNK, width)
            mean[b, :, y, x0:x1], variance[b, :, y, x0:x1], totals[:] = 0, 0, 0
            for t in range(size * size):
                dy, dx = (t // size - size // 2) * step, (t % size - size // 2) * step
                row, left, right = y + dy, max(x0, -dx), min(x1, width - dx)
                if row < 0 or row >= height or right <= left:
                    continue
                start, end, weight = left + dx, right + dx, buffer[: right - left]
                _weigh(weight, inputs, t, b, y, left, row, start)
                add(totals[left - x0 : right - x0], weight)
                for c in range(image.shape[1]):
                    add_product(mean[b, c, y, left:right], weight, image[b, c, row, start:end])
                for c in range(noise.shape[1]):
                    _add_square(variance[b, c, y, left:right], weight, noise[b, c, row, start:end])
            _divide(mean[b, :, y, x0:x1], variance[b, :, y, x0:x1], totals[: x1 - x0])


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
