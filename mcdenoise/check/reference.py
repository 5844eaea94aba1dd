"""The equations of all ops as loops over pixels and taps, in Python's float64 numbers.

These functions are slow, and written to be compared with the formulas by eye. They share no code with the ops, so that
both cannot have the same error. They take the arguments of the ops; their results are always float64.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from decimal import Decimal, localcontext
from typing import Any

import torch
from torch import Tensor

from mcdenoise.ops.temporal import Surface

# Nested lists of numbers, indexed [batch][channel][row][column].
Image = list[Any]


def kernel_conv(image: Tensor, kernel: Tensor, *, border: str = "replicate") -> Tensor:
    """Eq. 4: ``out[p] = sum_t kernel[t, p] image[p + o_t]``; ``"renormalize"`` divides by the sum of weights inside."""
    source, weights, out = image.tolist(), kernel.tolist(), _zeros(image.shape)
    for b, c, y, x in _indices(image.shape):
        total = inside = 0.0
        for t, _, row, column in _taps(kernel, y, x, border):
            weight = weights[b][t][y][x]
            if row is not None:
                total += weight * source[b][c][row][column]
                inside += weight
        if border == "renormalize":
            total = total / inside if inside != 0 else 0.0
        out[b][c][y][x] = total
    return _tensor(out, image.shape)


def kernel_splat(image: Tensor, kernel: Tensor, *, border: str = "replicate") -> Tensor:
    """``out[p + o_t] += kernel[t, p] image[p]``; ``"renormalize"`` first divides by the sum of weights inside."""
    source, weights, out = image.tolist(), kernel.tolist(), _zeros(image.shape)
    for b, c, y, x in _indices(image.shape):
        value = source[b][c][y][x]
        if border == "renormalize":
            inside = sum(weights[b][t][y][x] for t, _, row, _ in _taps(kernel, y, x, border) if row is not None)
            value = value / inside if inside != 0 else 0.0
        for t, _, row, column in _taps(kernel, y, x, border):
            if row is not None:
                out[b][c][row][column] += weights[b][t][y][x] * value
    return _tensor(out, image.shape)


def softmax_splat(image: Tensor, logits: Tensor) -> tuple[Tensor, Tensor]:
    """``sum exp(l) image / sum exp(l)`` over the splats at a pixel, and ``log(sum exp(l))``, in decimal numbers."""
    source, exponents = image.tolist(), logits.tolist()
    batch, channels, height, width = image.shape
    out, log_weight = _zeros(image.shape), _zeros((batch, 1, height, width))
    with localcontext(prec=40):
        for b, y, x in itertools.product(range(batch), range(height), range(width)):
            weights = {}
            # The splat of tap t comes from the pixel in the opposite direction.
            for t, _, row, column in _taps(logits, y, x, "zeros"):
                if row is not None:
                    weights[row, column] = Decimal(exponents[b][logits.shape[1] - 1 - t][row][column]).exp()
            total = sum(weights.values(), Decimal())
            log_weight[b][0][y][x] = float(total.ln())
            for c in range(channels):
                light = (weight * Decimal(source[b][c][row][column]) for (row, column), weight in weights.items())
                out[b][c][y][x] = float(sum(light, Decimal()) / total)
    return _tensor(out, image.shape), _tensor(log_weight, (batch, 1, height, width))


def cross_bilateral_weights(
    kernel: Tensor,
    guides: Sequence[Tensor] = (),
    falloffs: Sequence[Tensor] = (),
    distance_falloff: Tensor | None = None,
    *,
    normalize: str = "softmax",
    border: str = "replicate",
) -> Tensor:
    """Eqs. 5-8: ``w' = w * prod_g exp(-f_g |g(q) - g(p)|^2) * exp(-f_d |q - p|^2)``.

    ``"softmax"`` has ``w = exp(logit)``, and divides by the sum over the taps.
    """
    logits, out = kernel.tolist(), _zeros(kernel.shape)
    images = [guide.tolist() for guide in guides]
    factors = [scale.tolist() for scale in falloffs]
    factor_of_distance = None if distance_falloff is None else distance_falloff.tolist()
    batch, _, height, width = kernel.shape
    for b, y, x in itertools.product(range(batch), range(height), range(width)):
        exponents: dict[int, list[float]] = {}
        for t, squared_distance, row, column in _taps(kernel, y, x, border):
            if row is None and border == "renormalize":
                continue
            terms = exponents[t] = []
            for guide, factor in zip(images, factors, strict=True):
                difference = sum(
                    ((channel[row][column] if row is not None else 0.0) - channel[y][x]) ** 2 for channel in guide[b]
                )
                terms.append(-factor[b][0][y][x] * difference)
            if factor_of_distance is not None:
                terms.append(-factor_of_distance[b][0][y][x] * squared_distance)
        if normalize == "softmax":
            weights = _softmax({t: [logits[b][t][y][x], *terms] for t, terms in exponents.items()})
        else:
            weights = {t: logits[b][t][y][x] * math.exp(sum(terms)) for t, terms in exponents.items()}
        for t, weight in weights.items():
            out[b][t][y][x] = weight
    return _tensor(out, kernel.shape)


def _softmax(exponents: dict[int, list[float]]) -> dict[int, float]:
    """Softmax of the sum of terms of each key, in decimal numbers, which do not overflow like float64.

    Infinite terms are treated as limits of large ones.
    """
    infinite = [any(term == math.inf for term in terms) for terms in exponents.values()]
    vanishing = [any(term == -math.inf for term in terms) for terms in exponents.values()]
    if any(infinite) or all(vanishing):
        chosen = infinite if any(infinite) else vanishing
        return {t: float(wins) / sum(chosen) for t, wins in zip(exponents, chosen, strict=True)}
    with localcontext(prec=40):
        weights = [sum(map(Decimal, terms), Decimal()).exp() for terms in exponents.values()]
        total = sum(weights, Decimal())
        return {t: float(weight / total) for t, weight in zip(exponents, weights, strict=True)}


def cross_bilateral_filter(
    image: Tensor,
    kernel: Tensor,
    guides: Sequence[Tensor] = (),
    falloffs: Sequence[Tensor] = (),
    distance_falloff: Tensor | None = None,
    *,
    normalize: str = "softmax",
    border: str = "replicate",
) -> Tensor:
    """Eqs. 5-8, then Eq. 4."""
    weights = cross_bilateral_weights(kernel, guides, falloffs, distance_falloff, normalize=normalize, border=border)
    return kernel_conv(image, weights, border=border)


def downsample(image: Tensor) -> Tensor:
    """``D`` of Eq. 2: the mean of each 2x2 block, over the pixels inside the image."""
    batch, channels, height, width = image.shape
    shape = (batch, channels, (height + 1) // 2, (width + 1) // 2)
    source, out = image.tolist(), _zeros(shape)
    for b, c, y, x in _indices(shape):
        block = [
            source[b][c][row][column]
            for row in range(2 * y, min(2 * y + 2, height))
            for column in range(2 * x, min(2 * x + 2, width))
        ]
        out[b][c][y][x] = sum(block) / len(block)
    return _tensor(out, shape)


def upsample(image: Tensor, size: tuple[int, int]) -> Tensor:
    """``U`` of Eq. 2: ``out[y, x] = image[y // 2, x // 2]``."""
    shape = (*image.shape[:2], *size)
    source, out = image.tolist(), _zeros(shape)
    for b, c, y, x in _indices(shape):
        out[b][c][y][x] = source[b][c][y // 2][x // 2]
    return _tensor(out, shape)


def laplacian_fusion(fine: Tensor, coarse: Tensor, alpha: Tensor) -> Tensor:
    """Eq. 2: ``o = i_f - alpha U(D(i_f)) + alpha U(i_c)``."""
    size = (fine.shape[2], fine.shape[3])
    smooth, low = upsample(downsample(fine), size).tolist(), upsample(coarse, size).tolist()
    source, blend, out = fine.tolist(), alpha.tolist(), _zeros(fine.shape)
    for b, c, y, x in _indices(fine.shape):
        a = blend[b][c if alpha.shape[1] > 1 else 0][y][x]
        out[b][c][y][x] = source[b][c][y][x] - a * smooth[b][c][y][x] + a * low[b][c][y][x]
    return _tensor(out, fine.shape)


def pyramid_partition(image: Tensor, logits: Tensor) -> tuple[Tensor, ...]:
    """``out_i[q] = mean of softmax(logits)[i] image`` over the pixels of block ``q`` inside the image."""
    batch, channels, height, width = image.shape
    source, exponents, found = image.tolist(), logits.tolist(), []
    for level in range(logits.shape[1]):
        side = 2**level
        shape = (batch, channels, -(-height // side), -(-width // side))
        out = _zeros(shape)
        for b, c, i, j in _indices(shape):
            block = []
            for y in range(side * i, min(side * (i + 1), height)):
                for x in range(side * j, min(side * (j + 1), width)):
                    here = {k: [channel[y][x]] for k, channel in enumerate(exponents[b])}
                    block.append(_softmax(here)[level] * source[b][c][y][x])
            out[b][c][i][j] = sum(block) / len(block)
        found.append(_tensor(out, shape))
    return tuple(found)


def learned_upsample(image: Tensor, kernel: Tensor, size: tuple[int, int], *, border: str = "replicate") -> Tensor:
    """Tap ``(r, s)`` of coarse pixel ``(i, j)`` is added to ``(2 i + r - K / 2 + 1, 2 j + s - K / 2 + 1)``."""
    batch, channels, coarse_height, coarse_width = image.shape
    side, shape = math.isqrt(kernel.shape[1]), (batch, channels, *size)
    source, weights, out = image.tolist(), kernel.tolist(), _zeros(shape)
    for b, c, i, j in _indices(image.shape):
        for r, s in itertools.product(range(side), repeat=2):
            y, x = 2 * i + r - side // 2 + 1, 2 * j + s - side // 2 + 1
            if border == "replicate":
                y, x = _clamp(y, 2 * coarse_height), _clamp(x, 2 * coarse_width)
            if 0 <= y < size[0] and 0 <= x < size[1]:
                out[b][c][y][x] += weights[b][r * side + s][i][j] * source[b][c][i][j]
    return _tensor(out, shape)


def demodulate(color: Tensor, albedo: Tensor, *, floor: float = 4e-2) -> Tensor:
    """``color / max(albedo, floor)``; unchanged where the albedo is below 1e-4 in every channel."""
    source, modulation = color.tolist(), _modulation(albedo, floor)
    out = _zeros(color.shape)
    for b, c, y, x in _indices(color.shape):
        out[b][c][y][x] = source[b][c][y][x] / modulation[b][c][y][x]
    return _tensor(out, color.shape)


def remodulate(image: Tensor, albedo: Tensor, *, floor: float = 4e-2) -> Tensor:
    """``image * max(albedo, floor)``; unchanged where the albedo is below 1e-4 in every channel."""
    source, modulation = image.tolist(), _modulation(albedo, floor)
    out = _zeros(image.shape)
    for b, c, y, x in _indices(image.shape):
        out[b][c][y][x] = source[b][c][y][x] * modulation[b][c][y][x]
    return _tensor(out, image.shape)


def clamp_fireflies(image: Tensor, *, limit: float = 15.0, kernel_size: int = 7) -> Tensor:
    """``image[p] * min(1, limit n[p] / y[p])``, with the channel mean ``y`` and its mean ``n`` over lit neighbours."""
    source, out = image.tolist(), _zeros(image.shape)
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
    return _tensor(out, image.shape)


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
    out, out_noise = _zeros(light.shape), _zeros(variance.shape)
    kernel = (1 / 16, 4 / 16, 6 / 16, 4 / 16, 1 / 16)
    batch, _, height, width = light.shape
    same_surface = _edge_stopping(normal, depth, sigma_z, sigma_n)
    for b, y, x in itertools.product(range(batch), range(height), range(width)):
        blurred = sum(
            (2 - abs(dy)) * (2 - abs(dx)) / 16 * noise[b][0][_clamp(y + dy, height)][_clamp(x + dx, width)]
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
    return _tensor(out, light.shape), _tensor(out_noise, variance.shape)


def affinity_filter(
    image: Tensor,
    features: Tensor,
    bandwidth: Tensor,
    center: Tensor,
    previous: Tensor | None = None,
    previous_features: Tensor | None = None,
    previous_bandwidth: Tensor | None = None,
    previous_weight: Tensor | None = None,
    *,
    kernel_size: int = 7,
    dilation: int = 1,
) -> Tensor:
    """Means with weights ``exp(-a |f_p - f_q|^2)``, and ``c`` for the pixel itself; also over the previous frame."""
    frames: list[tuple[Image, Image, Image, Image | None]]
    frames = [(image.tolist(), features.tolist(), bandwidth.tolist(), None)]
    if previous is not None and previous_features is not None:
        assert previous_bandwidth is not None
        assert previous_weight is not None
        of_before = previous_bandwidth.tolist(), previous_weight.tolist()
        frames.append((previous.tolist(), previous_features.tolist(), *of_before))
    here, own, out = features.tolist(), center.tolist(), _zeros(image.shape)
    batch, channels, height, width = image.shape
    steps = range(-(kernel_size // 2), kernel_size // 2 + 1)
    for b, y, x in itertools.product(range(batch), range(height), range(width)):
        taps = []
        for source, there, band, known in frames:
            for i, j in itertools.product(steps, repeat=2):
                row, column = y + dilation * i, x + dilation * j
                if not (0 <= row < height and 0 <= column < width):
                    continue
                if known is None and (i, j) == (0, 0):
                    weight = max(own[b][0][y][x], 1e-6)
                else:
                    apart = sum((here[b][f][y][x] - there[b][f][row][column]) ** 2 for f in range(features.shape[1]))
                    weight = math.exp(-band[b][0][y][x] * apart)
                    weight *= 1 if known is None else known[b][0][row][column]
                taps.append((weight, [source[b][c][row][column] for c in range(channels)]))
        total = sum(weight for weight, _ in taps)
        for c in range(channels):
            out[b][c][y][x] = sum(weight * value[c] for weight, value in taps) / total
    return _tensor(out, image.shape)


def importance_filter(image: Tensor, importance: Tensor, *, kernel_size: int) -> Tensor:
    """Fan et al. 2021: means over a window, weighted by the softmax of the importance; taps outside are skipped."""
    source, worth, out = image.tolist(), importance.tolist(), _zeros(image.shape)
    radius, (_, _, height, width) = kernel_size // 2, image.shape
    for b, c, y, x in _indices(image.shape):
        rows = range(max(0, y - radius), min(height, y + radius + 1))
        taps = list(itertools.product(rows, range(max(0, x - radius), min(width, x + radius + 1))))
        largest = max(worth[b][0][row][column] for row, column in taps)
        weights = [math.exp(worth[b][0][row][column] - largest) for row, column in taps]
        total = math.fsum(w * source[b][c][row][column] for w, (row, column) in zip(weights, taps, strict=True))
        out[b][c][y][x] = total / math.fsum(weights)
    return _tensor(out, image.shape)


def luminance_moments(light: Tensor) -> Tensor:
    """``(l, l^2)`` with ``l = 0.2126 R + 0.7152 G + 0.0722 B``."""
    batch, _, height, width = light.shape
    shape = (batch, 2, height, width)
    source, out = light.tolist(), _zeros(shape)
    for b, y, x in itertools.product(range(batch), range(height), range(width)):
        red, green, blue = (source[b][c][y][x] for c in range(3))
        out[b][0][y][x] = bright = 0.2126 * red + 0.7152 * green + 0.0722 * blue
        out[b][1][y][x] = bright * bright
    return _tensor(out, shape)


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
    source, out = moments.tolist(), _zeros((batch, 1, height, width))
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
    return _tensor(out, (batch, 1, height, width))


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


def _clamp(place: int, size: int) -> int:
    return min(max(place, 0), size - 1)


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

    out, noises = _zeros(shape), [image[0] for image in variance.tolist()]
    for b, _, y, x in _indices(shape):
        long_mean, short_mean = mean(long, b, y, x), mean(short, b, y, x)
        smallest = 1e-3 * (abs(long_mean) + abs(short_mean)) / 2
        noise = mean(noises, b, y, x) / len(window(b, y, x)) + smallest**2
        z2 = (short_mean - long_mean) ** 2 / noise if noise > 0 else 0.0
        out[b][0][y][x] = min(max((z2 / threshold**2 - 1) / 3, 0.0), 1.0)
    return _tensor(out, shape)


def grid_splat(image: Tensor, guide: Tensor, *, cell: int = 8, bins: int = 32) -> tuple[Tensor, Tensor]:
    """``sum a image / sum a`` of each cell, and whether any ``a`` is above 0."""
    batch, channels, height, width = image.shape
    grid_shape = (-(-height // cell), -(-width // cell), bins)
    source, guides = image.tolist(), guide.tolist()
    grid, filled = _zeros((batch, channels, *grid_shape)), _zeros((batch, 1, *grid_shape))
    for b, v, u, w in _indices((batch, *grid_shape)):
        total, sums = 0.0, [0.0] * channels
        for y, x in itertools.product(range(height), range(width)):
            weight = _cell_weight(y, x, guides[b][0][y][x], v, u, w, cell, bins)
            total += weight
            for c in range(channels):
                sums[c] += weight * source[b][c][y][x]
        if total > 0:
            filled[b][0][v][u][w] = 1.0
            for c in range(channels):
                grid[b][c][v][u][w] = sums[c] / total
    return _tensor(grid, (batch, channels, *grid_shape)), _tensor(filled, (batch, 1, *grid_shape))


def grid_slice(grid: Tensor, filled: Tensor, guide: Tensor, *, cell: int = 8) -> Tensor:
    """``sum a filled grid / sum a filled`` over all cells; 0 where the divisor is 0."""
    batch, channels, *grid_shape = grid.shape
    shape = (batch, channels, *guide.shape[2:])
    means, known, guides, out = grid.tolist(), filled.tolist(), guide.tolist(), _zeros(shape)
    for b, y, x in _indices((batch, *guide.shape[2:])):
        total, sums = 0.0, [0.0] * channels
        for v, u, w in _indices(grid_shape):
            weight = _cell_weight(y, x, guides[b][0][y][x], v, u, w, cell, grid_shape[2]) * known[b][0][v][u][w]
            total += weight
            for c in range(channels):
                sums[c] += weight * means[b][c][v][u][w]
        for c in range(channels):
            out[b][c][y][x] = sums[c] / total if total > 0 else 0.0
    return _tensor(out, shape)


def _cell_weight(y: int, x: int, guide: float, v: int, u: int, w: int, cell: int, bins: int) -> float:
    """Weight of a pixel in a cell of a bilateral grid: a product of three tents."""
    z = 255 * min(max(guide, 0.0), 1.0)
    distances = ((x + 0.5) / cell - (u + 0.5), (y + 0.5) / cell - (v + 0.5), (z + 0.5) * bins / 256 - (w + 0.5))
    return math.prod(max(1 - math.sqrt(distance**2 + 1e-8), 0.0) for distance in distances)


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
    now, before, out = current.tolist(), previous.tolist(), _zeros(current.shape)
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
    return _tensor(out, current.shape)


def block_regression(
    image: Tensor,
    features: Tensor,
    *,
    block: int = 32,
    offset: tuple[int, int] = (0, 0),
    squares: int = 0,
    ridge: float = 1e-8,
) -> Tensor:
    """The normal equations of each block, ``(Z^T Z + n ridge) w = Z^T (y - m)``; ``out = m + Z w``.

    They are solved in decimal numbers, because their condition number is squared, for which float64 is too inaccurate.
    """
    batch, channels, height, width = image.shape
    source, guides, out = image.tolist(), features.tolist(), _zeros(image.shape)

    def blocks(size: int, start: int) -> list[range]:
        return [range(first, first + block) for first in range(-start, size, block)]

    def mirrored(place: int, size: int) -> int:
        return min(place % (2 * size), 2 * size - 1 - place % (2 * size))

    for b, rows, columns in itertools.product(range(batch), blocks(height, offset[0]), blocks(width, offset[1])):
        places = list(itertools.product(rows, columns))
        pixels = [(mirrored(y, height), mirrored(x, width)) for y, x in places]
        with localcontext(prec=60):
            values: list[list[Decimal]] = [[Decimal(feature[y][x]) for y, x in pixels] for feature in guides[b]]
            deviations = [_standardized(each, "1e-6") for each in values]
            for j in range(len(values) - squares, len(values)):
                curved = [z * u for z, u in zip(deviations[j], _standardized(values[j], "1e-18"), strict=True)]
                mean = _mean(curved)
                deviations.append([product - mean for product in curved])
            products = [[_product(z, other) for other in deviations] for z in deviations]
            for j in range(len(products)):
                products[j][j] += len(pixels) * Decimal(ridge)
            for c in range(channels):
                light = [Decimal(source[b][c][y][x]) for y, x in pixels]
                mean = _mean(light)
                right = [_product(z, [value - mean for value in light]) for z in deviations]
                found = _solved(products, right)
                for index, (y, x) in enumerate(places):
                    if 0 <= y < height and 0 <= x < width:
                        fitted = sum((w * z[index] for w, z in zip(found, deviations, strict=True)), mean)
                        out[b][c][y][x] = float(fitted)
    return _tensor(out, image.shape)


def _standardized(values: list[Decimal], minimum: str) -> list[Decimal]:
    """``(x - mean) / sqrt(variance + minimum * mean square)``."""
    mean, square = _mean(values), _mean([value * value for value in values])
    variance = _mean([(value - mean) ** 2 for value in values])
    size = (variance + Decimal(minimum) * square).sqrt()
    return [(value - mean) / size if size else Decimal(0) for value in values]


def _mean(values: list[Decimal]) -> Decimal:
    return sum(values, Decimal()) / len(values)


def _product(values: list[Decimal], others: list[Decimal]) -> Decimal:
    return sum((one * other for one, other in zip(values, others, strict=True)), Decimal())


def _solved(matrix: list[list[Decimal]], right: list[Decimal]) -> list[Decimal]:
    """Gaussian elimination; it needs no pivoting because the matrix is positive definite."""
    rows = [[*row, value] for row, value in zip(matrix, right, strict=True)]
    for j, pivot in enumerate(rows):
        for row in rows[j + 1 :]:
            factor = row[j] / pivot[j]
            for k in range(j, len(row)):
                row[k] -= factor * pivot[k]
    found: list[Decimal] = []
    for j in reversed(range(len(rows))):
        known = sum((w * a for w, a in zip(reversed(found), rows[j][j + 1 : -1], strict=True)), Decimal())
        found.append((rows[j][-1] - known) / rows[j][j])
    return found[::-1]


def motion_from_position(position: Tensor, previous_view_projection: Tensor) -> Tensor:
    """``clip = [x y z 1] @ M``; ``motion = ((clip.xy / clip.w + 1) / 2) (W, H) - centre``; infinite for ``w <= 0``."""
    batch, _, height, width = position.shape
    shape = (batch, 2, height, width)
    points, matrices, out = position.tolist(), previous_view_projection.tolist(), _zeros(shape)
    for b, y, x in itertools.product(range(batch), range(height), range(width)):
        point = [*(channel[y][x] for channel in points[b]), 1.0]
        clip = [sum(p * row[column] for p, row in zip(point, matrices[b], strict=True)) for column in range(4)]
        in_front = clip[3] > 0 and all(map(math.isfinite, point))
        out[b][0][y][x] = (clip[0] / clip[3] + 1) / 2 * width - (x + 0.5) if in_front else math.inf
        out[b][1][y][x] = (clip[1] / clip[3] + 1) / 2 * height - (y + 0.5) if in_front else math.inf
    return _tensor(out, shape)


def reproject(
    previous: Tensor,
    motion: Tensor,
    surface: Surface | None = None,
    previous_surface: Surface | None = None,
    *,
    rule: str = "relative",
    position_limit: float | None = None,
    normal_limit: float | None = None,
) -> tuple[Tensor, Tensor]:
    """``weight = sum_kept b_k`` and ``value = sum_kept b_k previous[q_k] / weight`` over the four bilinear taps."""
    batch, channels, height, width = previous.shape
    source, moved = previous.tolist(), motion.tolist()
    here, there = _surface(surface), _surface(previous_surface)
    value, kept_weight = _zeros(previous.shape), _zeros((batch, 1, height, width))
    for b, y, x in itertools.product(range(batch), range(height), range(width)):
        qx, qy = x + moved[b][0][y][x], y + moved[b][1][y][x]
        if not (math.isfinite(qx) and math.isfinite(qy)):
            continue
        current = _at(here, b, y, x)
        kept = [
            ((1 - abs(qx - column)) * (1 - abs(qy - row)), row, column, _at(there, b, row, column))
            for row in (math.floor(qy), math.floor(qy) + 1)
            for column in (math.floor(qx), math.floor(qx) + 1)
            if 0 <= row < height and 0 <= column < width
        ]
        kept = [tap for tap in kept if _same_surface(current, tap[3], rule, position_limit, normal_limit)]
        alike = [tap for tap in kept if current[3] is not None and current[3] == tap[3][3]]
        if sum(bilinear for bilinear, *_ in alike) > 1e-3:
            kept = alike
        total, sums = 0.0, [0.0] * channels
        for bilinear, row, column, _ in kept:
            total += bilinear
            for c in range(channels):
                sums[c] += bilinear * source[b][c][row][column]
        if total > 0:
            kept_weight[b][0][y][x] = total
            for c in range(channels):
                value[b][c][y][x] = sums[c] / total
    return _tensor(value, previous.shape), _tensor(kept_weight, (batch, 1, height, width))


def resample(previous: Tensor, motion: Tensor) -> Tensor:
    """``sum_k k(x_k - q_x) k(y_k - q_y) previous[q_k]``, limited to the range of the four nearest pixels."""
    _, channels, height, width = previous.shape
    source, moved, out = previous.tolist(), motion.tolist(), _zeros(previous.shape)
    for b, y, x in itertools.product(range(len(source)), range(height), range(width)):
        qx, qy = x + moved[b][0][y][x], y + moved[b][1][y][x]
        if not (math.isfinite(qx) and math.isfinite(qy)):
            continue
        qx, qy = min(max(qx, -1.0), float(width)), min(max(qy, -1.0), float(height))
        rows, columns = (range(math.floor(q) - 1, math.floor(q) + 3) for q in (qy, qx))
        for c in range(channels):
            taps = {
                (row, column): source[b][c][min(max(row, 0), height - 1)][min(max(column, 0), width - 1)]
                for row, column in itertools.product(rows, columns)
            }
            value = sum(_keys(row - qy) * _keys(column - qx) * tap for (row, column), tap in taps.items())
            nearest = [tap for (row, column), tap in taps.items() if row in rows[1:3] and column in columns[1:3]]
            out[b][c][y][x] = min(max(value, min(nearest)), max(nearest))
    return _tensor(out, previous.shape)


def _keys(distance: float) -> float:
    """Keys' kernel with a = -3/4."""
    a, d = -0.75, abs(distance)
    if d <= 1:
        return (a + 2) * d**3 - (a + 3) * d**2 + 1
    return a * d**3 - 5 * a * d**2 + 8 * a * d - 4 * a if d < 2 else 0.0


def accumulate(
    color: Tensor,
    previous: Tensor,
    previous_length: Tensor,
    motion: Tensor,
    surface: Surface | None = None,
    previous_surface: Surface | None = None,
    *,
    alpha_min: float = 0.1,
    rule: str = "relative",
    position_limit: float | None = None,
    normal_limit: float | None = None,
) -> tuple[Tensor, Tensor]:
    """``alpha = max(1 / (n + 1), alpha_min)``, ``alpha color + (1 - alpha) history``, ``n + 1``; else ``color``, 1."""
    fetch = functools.partial(reproject, rule=rule, position_limit=position_limit, normal_limit=normal_limit)
    history, weight = (tensor.tolist() for tensor in fetch(previous, motion, surface, previous_surface))
    lengths = fetch(previous_length, motion, surface, previous_surface)[0].tolist()
    source, out, length = color.tolist(), _zeros(color.shape), _zeros(previous_length.shape)
    for b, c, y, x in _indices(color.shape):
        n = lengths[b][0][y][x]
        found = weight[b][0][y][x] > 0
        alpha = max(1 / (n + 1), alpha_min) if found else 1.0
        out[b][c][y][x] = alpha * source[b][c][y][x] + (1 - alpha) * history[b][c][y][x]
        # The published code stores the length in a byte.
        grown = min(round(n) + 1, 255) if rule == "bmfr" else n + 1
        length[b][0][y][x] = grown if found else 1.0
    return _tensor(out, color.shape), _tensor(length, previous_length.shape)


def _tensor(values: Image, shape: Sequence[int]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64).reshape(tuple(shape))


def _zeros(shape: Sequence[int]) -> Image:
    zeros: Image = torch.zeros(tuple(shape), dtype=torch.float64).tolist()
    return zeros


def _indices(shape: Sequence[int]) -> Iterator[tuple[int, ...]]:
    return itertools.product(*(range(size) for size in shape))


def _taps(kernel: Tensor, y: int, x: int, border: str) -> Iterator[tuple[int, int, int | None, int]]:
    """Index, squared distance from the centre, row and column of each tap; the row of a skipped tap is ``None``."""
    _, taps, height, width = kernel.shape
    size = math.isqrt(taps)
    for t in range(taps):
        dy, dx = t // size - size // 2, t % size - size // 2
        row, column = y + dy, x + dx
        distance = dy * dy + dx * dx
        if border == "replicate":
            yield t, distance, min(max(row, 0), height - 1), min(max(column, 0), width - 1)
        elif 0 <= row < height and 0 <= column < width:
            yield t, distance, row, column
        else:
            yield t, distance, None, 0


def _modulation(albedo: Tensor, floor: float) -> Image:
    values, out = albedo.tolist(), _zeros(albedo.shape)
    for b, c, y, x in _indices(albedo.shape):
        textured = any(channel[y][x] >= 1e-4 for channel in values[b])
        out[b][c][y][x] = max(values[b][c][y][x], floor) if textured else 1.0
    return out


def _surface(surface: Surface | None) -> tuple[Image | None, ...]:
    return tuple(None if part is None else part.tolist() for part in surface or Surface())


def _at(surface: tuple[Image | None, ...], b: int, y: int, x: int) -> list[list[float] | None]:
    """Position, normal, depth and label of one pixel, each a vector or ``None``."""
    return [None if part is None else [channel[y][x] for channel in part[b]] for part in surface]


def _same_surface(
    here: list[list[float] | None],
    tap: list[list[float] | None],
    rule: str,
    position_limit: float | None,
    normal_limit: float | None,
) -> bool:
    # Buffers that one of the two surfaces lacks are not compared.
    both = [(a, b) if a is not None and b is not None else None for a, b in zip(here, tap, strict=True)]
    positions, normals, depths, _ = both
    if rule == "bmfr":
        limits = ((positions, position_limit), (normals, normal_limit))
        return all(pair is None or limit is None or _squared_distance(*pair) < limit for pair, limit in limits)
    if normals is not None and not _squared_distance(*normals) <= (0.5 if normal_limit is None else normal_limit):
        return False
    if depths is None:
        return True
    depth, tap_depth = depths[0][0], depths[1][0]
    if not math.isfinite(depth) or not math.isfinite(tap_depth):
        return not math.isfinite(depth) and not math.isfinite(tap_depth)
    if positions is None:
        return abs(tap_depth - depth) <= (0.1 if position_limit is None else position_limit) * depth
    if normals is None:
        distance = math.sqrt(_squared_distance(*positions))
    else:
        distance = abs(sum((q - p) * n for p, q, n in zip(*positions, normals[0], strict=True)))
    return distance <= (0.02 if position_limit is None else position_limit) * depth


def _squared_distance(a: list[float], b: list[float]) -> float:
    return sum((q - p) ** 2 for p, q in zip(a, b, strict=True))
