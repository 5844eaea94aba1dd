"""Errors of all methods on the frames of a scene."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import NamedTuple

import torch
from torch import Tensor

from mcdenoise.evaluate import METRICS, USUAL, measure
from mcdenoise.results import Spread


class _Previous(NamedTuple):
    number: int
    image: Tensor
    reference: Tensor


class Errors:
    """Accumulates the errors of any number of methods; keeps only the previous image of each.

    Args:
        metrics: names in :data:`mcdenoise.evaluate.METRICS`.
        flip_every: compute FLIP, which is slow, only for every n-th frame.

    Attributes:
        skipped: by metric, the reason if it could not be computed for some images, such as a package that is not
            installed.
    """

    def __init__(self, metrics: Collection[str] = USUAL, flip_every: int = 1) -> None:
        self.skipped: dict[str, str] = {}
        self._metrics = {name: METRICS[name] for name in METRICS if name in metrics}
        self._flip_every = flip_every
        self._count: dict[str, int] = {}
        self._previous: dict[str, _Previous] = {}
        self._values: dict[str, dict[str, list[float]]] = {}

    @torch.inference_mode()
    def add(self, method: str, number: int, image: Tensor, reference: Tensor) -> None:
        """Compare an image with its reference; temporal metrics also use the previous frame, if it was added.

        Args:
            method: name of the method.
            number: frame number.
            image: ``(1, 3, H, W)`` scene-linear radiance.
            reference: the same shape, on the same device.
        """
        previous = self._previous.get(method)
        if previous is not None and previous.number != number - 1:
            previous = None
        before = None if previous is None else (previous.image, previous.reference)
        count = self._count.setdefault(method, 0)
        self._count[method] += 1
        metrics = {
            name: metric for name, metric in self._metrics.items() if name != "FLIP" or not count % self._flip_every
        }
        values = self._values.setdefault(method, {})
        for name, value in measure(metrics, image, reference, before, self.skipped).items():
            values.setdefault(name, []).append(value)
        self._previous[method] = _Previous(number, image, reference)

    def means(self, method: str) -> dict[str, float]:
        """Mean of each metric; a metric that is not finite, such as the PSNR of equal images, is omitted."""
        return {name: sum(values) / len(values) for name, values in self._finite(method).items()}

    def spreads(self, method: str) -> dict[str, Spread]:
        """As :meth:`means`."""
        return {name: Spread.of(values) for name, values in self._finite(method).items()}

    def _finite(self, method: str) -> dict[str, list[float]]:
        values = self._values.get(method, {})
        return {name: own for name, own in values.items() if all(math.isfinite(value) for value in own)}
