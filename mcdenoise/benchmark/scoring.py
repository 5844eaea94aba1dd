"""Errors of every method on the frames of a scene."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import NamedTuple

import torch
from torch import Tensor

from mcdenoise.errors import InputError
from mcdenoise.evaluate import METRICS
from mcdenoise.results import Spread

# Larger than the window of any metric.
_TRIAL_SIZE = 32


class _Past(NamedTuple):
    number: int
    image: Tensor
    reference: Tensor


def usable_metrics() -> tuple[list[str], list[str]]:
    """Names in :data:`mcdenoise.evaluate.METRICS`, and a note for each that needs a package which is not installed."""
    usable, notes = [], []
    for name, metric in METRICS.items():
        image = torch.full((1, 3, _TRIAL_SIZE, _TRIAL_SIZE), 0.5)
        trial = torch.stack([image, image], 1) if metric.temporal else image
        try:
            metric.function(trial, trial)
            usable.append(name)
        except InputError as error:
            notes.append(f"{name} is left out: {error}")
    return usable, notes


class Errors:
    """Errors of any number of methods, frame by frame; keeps only the previous image of each.

    Args:
        metrics: names in :data:`mcdenoise.evaluate.METRICS`.
    """

    def __init__(self, metrics: Collection[str]) -> None:
        self._metrics = metrics
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
        follows = past is not None and past.number == number - 1
        values = self._values.setdefault(method, {})
        for name in self._metrics:
            metric = METRICS[name]
            if not metric.temporal:
                value = metric.function(image, reference)
            elif past is not None and follows:
                clips = torch.stack([past.image, image], 1), torch.stack([past.reference, reference], 1)
                value = metric.function(*clips)
            else:
                continue
            values.setdefault(name, []).append(float(value))
        self._past[method] = _Past(number, image, reference)

    def means(self, method: str) -> dict[str, float]:
        """Of each metric; one that is not finite, as the PSNR of an image that equals its reference, is left out."""
        return {name: sum(values) / len(values) for name, values in self._finite(method).items()}

    def spreads(self, method: str) -> dict[str, Spread]:
        """As :meth:`means`."""
        return {name: Spread.of(values) for name, values in self._finite(method).items()}

    def _finite(self, method: str) -> dict[str, list[float]]:
        values = self._values.get(method, {})
        return {name: own for name, own in values.items() if all(math.isfinite(value) for value in own)}
