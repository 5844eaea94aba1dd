"""Errors of every method on the frames of a scene."""

from __future__ import annotations

import math
from collections.abc import Collection

import torch
from torch import Tensor

from mcdenoise.evaluate import METRICS, USUAL, Scores
from mcdenoise.results import Spread


class Errors:
    """Accumulates the errors of any number of methods, frame by frame; stores only the previous image of each.

    Args:
        metrics: names in :data:`mcdenoise.evaluate.METRICS`.

    Attributes:
        skipped: reasons, by metric, why it could not be computed for one or all images, such as a missing package.
    """

    def __init__(self, metrics: Collection[str] = USUAL) -> None:
        self.skipped: dict[str, str] = {}
        self._metrics = {name: METRICS[name] for name in METRICS if name in metrics}
        self._scores: dict[str, Scores] = {}

    @torch.inference_mode()
    def add(self, method: str, number: int, image: Tensor, reference: Tensor) -> None:
        """Compare an image with its reference; temporal metrics also use the previous frame, if it was added.

        Args:
            method: name of the method.
            number: number of the frame.
            image: ``(1, 3, H, W)`` scene-linear radiance.
            reference: of the same shape, on the same device.
        """
        self._scores.setdefault(method, Scores(skipped=self.skipped)).add(self._metrics, number, image, reference)

    def means(self, method: str) -> dict[str, float]:
        """Mean of each metric; metrics with infinite values are skipped, such as the PSNR of a perfect image."""
        return {name: sum(values) / len(values) for name, values in self._finite(method).items()}

    def spreads(self, method: str) -> dict[str, Spread]:
        """Median and quartiles of each metric; skips the same metrics as :meth:`means`."""
        return {name: Spread.of(values) for name, values in self._finite(method).items()}

    def _finite(self, method: str) -> dict[str, list[float]]:
        columns = self._scores[method].columns if method in self._scores else {}
        return {name: own for name, own in columns.items() if all(math.isfinite(value) for value in own)}
