"""Errors of every method on the frames of a scene."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from mcdenoise.errors import InputError
from mcdenoise.evaluate import METRICS
from mcdenoise.results import Spread


class _Past(NamedTuple):
    number: int
    image: Tensor
    reference: Tensor


class Errors:
    """Errors of any number of methods, frame by frame; keeps only the previous image of each.

    Args:
        left_out: by name of a metric in :data:`mcdenoise.evaluate.METRICS`, why it could not be computed for some image
            or for any, such as a package that is not installed.
    """

    def __init__(self) -> None:
        self.left_out: dict[str, str] = {}
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
        values = self._values.setdefault(method, {})
        for name, metric in METRICS.items():
            try:
                if not metric.temporal:
                    value = metric.function(image, reference)
                elif past is not None:
                    clips = torch.stack([past.image, image], 1), torch.stack([past.reference, reference], 1)
                    value = metric.function(*clips)
                else:
                    continue
            except InputError as error:
                self.left_out[name] = str(error)
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
