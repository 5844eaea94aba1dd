"""Errors of every method on the frames of a scene."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from mcdenoise.evaluate import METRICS, measure
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
        before = None if past is None else (past.image, past.reference)
        values = self._values.setdefault(method, {})
        for name, value in measure(METRICS, image, reference, before, self.left_out).items():
            values.setdefault(name, []).append(value)
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
