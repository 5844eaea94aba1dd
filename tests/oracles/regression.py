"""Regression in decimal numbers."""

import itertools
from decimal import Decimal, localcontext

from torch import Tensor

from oracles.loops import tensor_of, zeros


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
    source, guides, out = image.tolist(), features.tolist(), zeros(image.shape)

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
    return tensor_of(out, image.shape)


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
