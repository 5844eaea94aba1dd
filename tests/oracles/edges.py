"""Windows that stop at edges, and tests of brightness."""

import itertools
import math
from collections.abc import Callable

import torch
from torch import Tensor

from oracles.loops import Image, clamped, indices, tensor_of, zeros


def clamp_fireflies(image: Tensor, *, limit: float = 15.0, kernel_size: int = 7) -> Tensor:
    """``image[p] * min(1, limit n[p] / y[p])``, with the channel mean ``y`` and its mean ``n`` over lit neighbours."""
    source, out = image.tolist(), zeros(image.shape)
    batch, channels, height, width = image.shape
    radius = kernel_size // 2
    for b, y, x in itertools.product(range(batch), range(height), range(width)):
        brightness = sum(source[b][c][y][x] for c in range(channels)) / channels
        others = [
            sum(source[b][c][row][column] for c in range(channels)) / channels
            for row in range(max(y - radius, 0), min(y + radius + 1, height))
            for column in range(max(x - radius, 0), min(x + radius + 1, width))
            if (row, column) != (y, x)
        ]
        lit = [other for other in others if other > 0]
        highest = limit * sum(lit) / len(lit) if lit else math.inf
        factor = highest / brightness if brightness > highest else 1.0
        for c in range(channels):
            out[b][c][y][x] = source[b][c][y][x] * factor
    return tensor_of(out, image.shape)


def atrous(
    light: Tensor,
    variance: Tensor,
    normal: Tensor | None = None,
    depth: Tensor | None = None,
    *,
    step: int = 1,
    sigma_z: float = 1.0,
    sigma_n: float = 128.0,
    sigma_l: float = 4.0,
) -> tuple[Tensor, Tensor]:
    """SVGF, Eqs. 1-5: weighted means of light and variance over 5x5 taps that are ``step`` pixels apart."""
    source, noise, bright = light.tolist(), variance.tolist(), luminance_moments(light).tolist()
    out, out_noise = zeros(light.shape), zeros(variance.shape)
    kernel = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)
    batch, _, height, width = light.shape
    same_surface = _edge_stopping(normal, depth, sigma_z, sigma_n)
    for b, y, x in itertools.product(range(batch), range(height), range(width)):
        blurred = sum(
            (2 - abs(dy)) * (2 - abs(dx)) / 16 * noise[b][0][clamped(y + dy, height)][clamped(x + dx, width)]
            for dy, dx in itertools.product((-1, 0, 1), repeat=2)
        )
        deviation = sigma_l * math.sqrt(blurred + 1e-20)
        taps = []
        for i, j in itertools.product(range(5), repeat=2):
            row, column = y + step * (i - 2), x + step * (j - 2)
            if 0 <= row < height and 0 <= column < width:
                w = same_surface(b, y, x, row, column)
                w *= math.exp(-abs(bright[b][0][row][column] - bright[b][0][y][x]) / deviation)
                taps.append((row, column, kernel[i] * kernel[j] * w))
        total = sum(weight for _, _, weight in taps)
        for c in range(3):
            out[b][c][y][x] = sum(weight * source[b][c][row][column] for row, column, weight in taps) / total
        out_noise[b][0][y][x] = sum(weight**2 * noise[b][0][row][column] for row, column, weight in taps) / total**2
    return tensor_of(out, light.shape), tensor_of(out_noise, variance.shape)


def luminance_moments(light: Tensor) -> Tensor:
    """``(l, l^2)`` with ``l = 0.2126 R + 0.7152 G + 0.0722 B``."""
    batch, _, height, width = light.shape
    shape = (batch, 2, height, width)
    source, out = light.tolist(), zeros(shape)
    for b, y, x in itertools.product(range(batch), range(height), range(width)):
        red, green, blue = (source[b][c][y][x] for c in range(3))
        out[b][0][y][x] = bright = 0.2126 * red + 0.7152 * green + 0.0722 * blue
        out[b][1][y][x] = bright * bright
    return tensor_of(out, shape)


def moments_variance(
    moments: Tensor,
    normal: Tensor | None = None,
    depth: Tensor | None = None,
    *,
    kernel_size: int = 1,
    sigma_z: float = 1.0,
    sigma_n: float = 128.0,
) -> Tensor:
    """``max(0, m2 - m1^2)`` of the weighted mean ``m`` of the moments over a window."""
    batch, _, height, width = moments.shape
    source, out = moments.tolist(), zeros((batch, 1, height, width))
    same_surface, radius = _edge_stopping(normal, depth, sigma_z, sigma_n), kernel_size // 2
    for b, y, x in itertools.product(range(batch), range(height), range(width)):
        taps = [
            (row, column, same_surface(b, y, x, row, column))
            for row in range(max(y - radius, 0), min(y + radius + 1, height))
            for column in range(max(x - radius, 0), min(x + radius + 1, width))
        ]
        total = sum(weight for _, _, weight in taps)
        first, second = (sum(w * source[b][c][row][column] for row, column, w in taps) / total for c in range(2))
        out[b][0][y][x] = max(0.0, second - first * first)
    return tensor_of(out, (batch, 1, height, width))


def _edge_stopping(
    normal: Tensor | None, depth: Tensor | None, sigma_z: float, sigma_n: float
) -> Callable[[int, int, int, int, int], float]:
    """SVGF, Eqs. 3 and 4: ``w_z w_n`` of a pixel and a tap; background matches background."""
    normals, depths = (None if image is None else image.tolist() for image in (normal, depth))

    def slope(z: list[list[float]], y: int, x: int, dy: int, dx: int) -> float:
        steps = [math.inf]
        for start in (-1, 0):
            ends = [(y + (start + 1) * dy, x + (start + 1) * dx), (y + start * dy, x + start * dx)]
            if all(0 <= row < len(z) and 0 <= column < len(z[0]) for row, column in ends):
                after, before = (z[row][column] for row, column in ends)
                if math.isfinite(after) and math.isfinite(before):
                    steps.append(after - before)
        smallest = min(steps, key=abs)
        return 0.0 if math.isinf(smallest) else smallest

    def weight(b: int, y: int, x: int, row: int, column: int) -> float:
        result = 1.0
        if depths is not None:
            z = depths[b][0]
            here, there = z[y][x], z[row][column]
            if math.isfinite(here) != math.isfinite(there):
                return 0.0
            if math.isfinite(here):
                along = slope(z, y, x, 0, 1) * (column - x) + slope(z, y, x, 1, 0) * (row - y)
                result *= math.exp(-abs(there - here) / (sigma_z * abs(along) + 1e-3 * here + 1e-30))
        if normals is not None:
            squared = sum((channel[row][column] - channel[y][x]) ** 2 for channel in normals[b])
            result *= max(0.0, 1 - squared / 2) ** sigma_n
        return result

    return weight


def history_lag(
    history: Tensor, recent: Tensor, variance: Tensor, *, threshold: float = 2.0, kernel_size: int = 5
) -> Tensor:
    """``clamp((z^2 / threshold^2 - 1) / 3, 0, 1)``, where ``z`` is the difference of local means in standard errors."""
    batch, channels, height, width = history.shape
    shape = (batch, 1, height, width)
    long, short = (
        [
            [
                [math.fsum(image[b][c][y][x] for c in range(channels)) / channels for x in range(width)]
                for y in range(height)
            ]
            for b in range(batch)
        ]
        for image in (history.tolist(), recent.tolist())
    )
    radius = kernel_size // 2

    def window(b: int, y: int, x: int) -> list[tuple[int, int]]:
        rows = range(max(y - radius, 0), min(y + radius + 1, height))
        columns = range(max(x - radius, 0), min(x + radius + 1, width))
        return list(itertools.product(rows, columns))

    def mean(image: Image, b: int, y: int, x: int) -> float:
        pixels = window(b, y, x)
        return math.fsum(image[b][row][column] for row, column in pixels) / len(pixels)

    out, noises = zeros(shape), [image[0] for image in variance.tolist()]
    for b, _, y, x in indices(shape):
        long_mean, short_mean = mean(long, b, y, x), mean(short, b, y, x)
        smallest = 1e-3 * (abs(long_mean) + abs(short_mean)) / 2
        noise = mean(noises, b, y, x) / len(window(b, y, x)) + smallest**2
        z2 = (short_mean - long_mean) ** 2 / noise if noise > 0 else 0.0
        out[b][0][y][x] = min(max((z2 / threshold**2 - 1) / 3, 0.0), 1.0)
    return tensor_of(out, shape)


def temporal_gradient(
    current: Tensor,
    previous: Tensor,
    weight: Tensor | None = None,
    variance: Tensor | None = None,
    normal: Tensor | None = None,
    depth: Tensor | None = None,
    *,
    stratum: int = 3,
    levels: int = 5,
    threshold: float = 2.0,
    sigma_z: float = 1.0,
    sigma_n: float = 128.0,
) -> Tensor:
    """``sqrt((D^2 - threshold^2 V) / M^2)`` of sums over strata, smoothed over neighbours on the same surface."""
    now, before, out = current.tolist(), previous.tolist(), zeros(current.shape)
    weights = torch.ones_like(current).tolist() if weight is None else weight.tolist()
    noises = torch.zeros_like(current).tolist() if variance is None else variance.tolist()
    batch, _, height, width = current.shape
    rows, columns = range(-(-height // stratum)), range(-(-width // stratum))
    middles = [
        [min(stratum * index + stratum // 2, size - 1) for index in strata]
        for strata, size in ((rows, height), (columns, width))
    ]
    coarse_normal, coarse_depth = (
        None if image is None else image[:, :, middles[0]][..., middles[1]] for image in (normal, depth)
    )
    same_surface = _edge_stopping(coarse_normal, coarse_depth, sigma_z, sigma_n)
    for b in range(batch):
        image = {}
        largest = max(abs(value) for each in (now, before) for row in each[b][0] for value in row)
        for i, j in itertools.product(rows, columns):
            sums = [0.0, 0.0, 0.0]
            for y in range(stratum * i, min(stratum * (i + 1), height)):
                for x in range(stratum * j, min(stratum * (j + 1), width)):
                    w, new, old = (each[b][0][y][x] for each in (weights, now, before))
                    for k, term in enumerate((w * (new - old), w * max(new, old), w * w * noises[b][0][y][x])):
                        sums[k] += term
            image[i, j] = sums
        for level in range(levels):
            filtered = {}
            for i, j in image:
                taps = [
                    (place, same_surface(b, i, j, *place))
                    for dy, dx in itertools.product((-1, 0, 1), repeat=2)
                    if (place := (i + dy * 2**level, j + dx * 2**level)) in image
                ]
                total = sum(w for _, w in taps)
                change, size = (sum(w * image[place][k] for place, w in taps) / total for k in range(2))
                filtered[i, j] = [change, size, sum(w * w * image[place][2] for place, w in taps) / total**2]
            image = filtered
        for y, x in itertools.product(range(height), range(width)):
            change, size, noise = image[y // stratum, x // stratum]
            if size > 1e-15 * largest * stratum**2:
                squared = (change / size) ** 2 - (threshold * math.sqrt(noise) / size) ** 2
                out[b][0][y][x] = min(1.0, math.sqrt(max(0.0, squared)))
    return tensor_of(out, current.shape)
