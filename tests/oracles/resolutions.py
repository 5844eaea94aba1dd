"""Resolutions, albedo, and the bilateral grid."""

import itertools
import math

from torch import Tensor

from oracles.loops import clamped, indices, softmax_of, tensor_of, zeros


def downsample(image: Tensor) -> Tensor:
    """``D`` of Eq. 2: the mean of each 2x2 block, over the pixels inside the image."""
    batch, channels, height, width = image.shape
    shape = (batch, channels, (height + 1) // 2, (width + 1) // 2)
    source, out = image.tolist(), zeros(shape)
    for b, c, y, x in indices(shape):
        block = [
            source[b][c][row][column]
            for row in range(2 * y, min(2 * y + 2, height))
            for column in range(2 * x, min(2 * x + 2, width))
        ]
        out[b][c][y][x] = sum(block) / len(block)
    return tensor_of(out, shape)


def upsample(image: Tensor, size: tuple[int, int]) -> Tensor:
    """``U`` of Eq. 2: ``out[y, x] = image[y // 2, x // 2]``."""
    shape = (*image.shape[:2], *size)
    source, out = image.tolist(), zeros(shape)
    for b, c, y, x in indices(shape):
        out[b][c][y][x] = source[b][c][y // 2][x // 2]
    return tensor_of(out, shape)


def laplacian_fusion(fine: Tensor, coarse: Tensor, alpha: Tensor) -> Tensor:
    """Eq. 2: ``o = i_f - alpha U(D(i_f)) + alpha U(i_c)``."""
    size = (fine.shape[2], fine.shape[3])
    smooth, low = upsample(downsample(fine), size).tolist(), upsample(coarse, size).tolist()
    source, blend, out = fine.tolist(), alpha.tolist(), zeros(fine.shape)
    for b, c, y, x in indices(fine.shape):
        a = blend[b][c if alpha.shape[1] > 1 else 0][y][x]
        out[b][c][y][x] = source[b][c][y][x] - a * smooth[b][c][y][x] + a * low[b][c][y][x]
    return tensor_of(out, fine.shape)


def pyramid_partition(image: Tensor, logits: Tensor) -> tuple[Tensor, ...]:
    """``out_i[q] = mean of softmax(logits)[i] image`` over the pixels of block ``q`` inside the image."""
    batch, channels, height, width = image.shape
    source, exponents, found = image.tolist(), logits.tolist(), []
    for level in range(logits.shape[1]):
        side = 2**level
        shape = (batch, channels, -(-height // side), -(-width // side))
        out = zeros(shape)
        for b, c, i, j in indices(shape):
            block = []
            for y in range(side * i, min(side * (i + 1), height)):
                for x in range(side * j, min(side * (j + 1), width)):
                    here = {k: [channel[y][x]] for k, channel in enumerate(exponents[b])}
                    block.append(softmax_of(here)[level] * source[b][c][y][x])
            out[b][c][i][j] = sum(block) / len(block)
        found.append(tensor_of(out, shape))
    return tuple(found)


def learned_upsample(image: Tensor, kernel: Tensor, size: tuple[int, int], *, border: str = "replicate") -> Tensor:
    """Tap ``(r, s)`` of coarse pixel ``(i, j)`` is added to ``(2 i + r - K / 2 + 1, 2 j + s - K / 2 + 1)``."""
    batch, channels, coarse_height, coarse_width = image.shape
    side, shape = math.isqrt(kernel.shape[1]), (batch, channels, *size)
    source, weights, out = image.tolist(), kernel.tolist(), zeros(shape)
    for b, c, i, j in indices(image.shape):
        for r, s in itertools.product(range(side), repeat=2):
            y, x = 2 * i + r - side // 2 + 1, 2 * j + s - side // 2 + 1
            if border == "replicate":
                y, x = clamped(y, 2 * coarse_height), clamped(x, 2 * coarse_width)
            if 0 <= y < size[0] and 0 <= x < size[1]:
                out[b][c][y][x] += weights[b][r * side + s][i][j] * source[b][c][i][j]
    return tensor_of(out, shape)


def demodulate(color: Tensor, albedo: Tensor, *, floor: float = 4e-2) -> Tensor:
    """``color / max(albedo, floor)``; unchanged where the albedo is below 1e-4 in every channel."""
    return color.double() / _modulation(albedo, floor)


def remodulate(image: Tensor, albedo: Tensor, *, floor: float = 4e-2) -> Tensor:
    """``image * max(albedo, floor)``; unchanged where the albedo is below 1e-4 in every channel."""
    return image.double() * _modulation(albedo, floor)


def _modulation(albedo: Tensor, floor: float) -> Tensor:
    values, out = albedo.tolist(), zeros(albedo.shape)
    for b, c, y, x in indices(albedo.shape):
        textured = any(channel[y][x] >= 1e-4 for channel in values[b])
        out[b][c][y][x] = max(values[b][c][y][x], floor) if textured else 1.0
    return tensor_of(out, albedo.shape)


def grid_splat(image: Tensor, guide: Tensor, *, cell: int = 8, bins: int = 32) -> tuple[Tensor, Tensor]:
    """``sum a image / sum a`` of each cell, and whether any ``a`` is above 0."""
    batch, channels, height, width = image.shape
    grid_shape = (-(-height // cell), -(-width // cell), bins)
    source, guides = image.tolist(), guide.tolist()
    grid, filled = zeros((batch, channels, *grid_shape)), zeros((batch, 1, *grid_shape))
    for b, v, u, w in indices((batch, *grid_shape)):
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
    return tensor_of(grid, (batch, channels, *grid_shape)), tensor_of(filled, (batch, 1, *grid_shape))


def grid_slice(grid: Tensor, filled: Tensor, guide: Tensor, *, cell: int = 8) -> Tensor:
    """``sum a filled grid / sum a filled`` over all cells; 0 where the divisor is 0."""
    batch, channels, *grid_shape = grid.shape
    shape = (batch, channels, *guide.shape[2:])
    means, known, guides, out = grid.tolist(), filled.tolist(), guide.tolist(), zeros(shape)
    for b, y, x in indices((batch, *guide.shape[2:])):
        total, sums = 0.0, [0.0] * channels
        for v, u, w in indices(grid_shape):
            weight = _cell_weight(y, x, guides[b][0][y][x], v, u, w, cell, grid_shape[2]) * known[b][0][v][u][w]
            total += weight
            for c in range(channels):
                sums[c] += weight * means[b][c][v][u][w]
        for c in range(channels):
            out[b][c][y][x] = sums[c] / total if total > 0 else 0.0
    return tensor_of(out, shape)


def _cell_weight(y: int, x: int, guide: float, v: int, u: int, w: int, cell: int, bins: int) -> float:
    """Weight of a pixel in a cell of a bilateral grid: a product of three tents."""
    z = 255 * min(max(guide, 0.0), 1.0)
    distances = ((x + 0.5) / cell - (u + 0.5), (y + 0.5) / cell - (v + 0.5), (z + 0.5) * bins / 256 - (w + 0.5))
    return math.prod(max(1 - math.sqrt(distance**2 + 1e-8), 0.0) for distance in distances)
