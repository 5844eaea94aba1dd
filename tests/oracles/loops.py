"""Images as nested lists of numbers, and the taps of a window."""

import itertools
import math
from collections.abc import Iterator, Sequence
from decimal import Decimal, localcontext
from typing import Any

import torch
from torch import Tensor

# Nested lists of numbers, indexed [batch][channel][row][column].
Image = list[Any]


def tensor_of(values: Image, shape: Sequence[int]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64).reshape(tuple(shape))


def zeros(shape: Sequence[int]) -> Image:
    zeros: Image = torch.zeros(tuple(shape), dtype=torch.float64).tolist()
    return zeros


def indices(shape: Sequence[int]) -> Iterator[tuple[int, ...]]:
    return itertools.product(*(range(size) for size in shape))


def taps_of(kernel: Tensor, y: int, x: int, border: str) -> Iterator[tuple[int, int, int | None, int]]:
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


def softmax_of(exponents: dict[int, list[float]]) -> dict[int, float]:
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


def clamped(place: int, size: int) -> int:
    return min(max(place, 0), size - 1)
