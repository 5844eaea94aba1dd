"""Errors of every method on the frames of a scene."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import NamedTuple

import torch
from torch import Tensor

from mcdenoise.evaluate import METRICS, USUAL, measure
from mcdenoise.results import Spread


class _Past(NamedTuple):
    number: int
    image: Tensor
    reference: Tensor


class Errors:
    """Errors of any number of methods, frame by frame; keeps only the previous image of each.

    Args:
        metrics: names in :data:`mcdenoise.evaluate.METRICS`.
        flip_every: FLIP is slow: compute it for the first of so many frames.

    Attributes:
        skipped: by name of a metric, why it could not be computed for some image or for any, such as a package that is
            not installed.
    """

    def __init__(self, metrics: Collection[str] = USUAL, flip_every: int = 1) -> None:
        self.skipped: dict[str, str] = {}
        self._metrics = {name: METRICS[name] for name in METRICS if name in metrics}
        self._flip_every = flip_every
        self._count: dict[str, int] = {}
        self._past: dict[str, _Past] = {}
        self._values: dict[str, dict[str, list[float]]] = {}

    @torch.inference_mode()
    def add(self, method: str, number: int, image: Tensor, reference: Tensor) -> None:
        """Compare an image with its reference; temporal metrics take it with the frame before, if that was added.

        Args:
            method: its name.
            number: of the frame.
            image: ``(1, 3, H, W)`` scene-linear radiance.
            reference: of the same shape, on the same device.
        """
        past = self._past.get(method)
        if past is not None and past.number != number - 1:
            past = None
        before = None if past is None else (past.image, past.reference)
        count = self._count.setdefault(method, 0)
        self._count[method] += 1
        metrics = {
            name: metric for name, metric in self._metrics.items() if name != "FLIP" or not count % self._flip_every
        }
        values = self._values.setdefault(method, {})
        for name, value in measure(metrics, image, reference, before, self.skipped).items():
            values.setdefault(name, []).append(value)
        self._past[method] = _Past(number, image, reference)

    def means(self, method: str) -> dict[str, float]:
        """Of each metric; one that is not finite, as the PSNR of an image that equals its reference, is skipped."""
        return {name: sum(values) / len(values) for name, values in self._finite(method).items()}

    def spreads(self, method: str) -> dict[str, Spread]:
        """As :meth:`means`."""
        return {name: Spread.of(values) for name, values in self._finite(method).items()}

    def _finite(self, method: str) -> dict[str, list[float]]:
        values = self._values.get(method, {})
        return {name: own for name, own in values.items() if all(math.isfinite(value) for value in own)}
