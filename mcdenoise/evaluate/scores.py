"""The metrics by which methods are compared, and their values for one frame."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from mcdenoise.data import Sequence
from mcdenoise.errors import InputError
from mcdenoise.metrics import (
    Metric,
    UncomputableError,
    flip_srgb,
    psnr_gamma,
    psnr_srgb,
    relmse_linear,
    rmse_linear,
    smape_linear,
    ssim_srgb,
    temporal_rmse_srgb,
    temporal_smape_linear,
)

METRICS: dict[str, Metric] = {
    "SMAPE": Metric(smape_linear),
    "relMSE": Metric(relmse_linear),
    "RMSE": Metric(rmse_linear),
    "PSNR": Metric(psnr_srgb, higher_is_better=True),
    "SSIM": Metric(ssim_srgb, higher_is_better=True),
    "FLIP": Metric(flip_srgb),
    "tSMAPE": Metric(temporal_smape_linear, temporal=True),
    "tRMSE": Metric(temporal_rmse_srgb, temporal=True),
    # For comparison with published tables; it is computed only on request.
    "PSNR 2.2": Metric(psnr_gamma, higher_is_better=True),
}
USUAL = tuple(name for name in METRICS if name != "PSNR 2.2")


def measure(
    metrics: Mapping[str, Metric],
    image: Tensor,
    reference: Tensor,
    previous: tuple[Tensor, Tensor] | None = None,
    skipped: dict[str, str] | None = None,
) -> dict[str, float]:
    """Compute all metrics of one frame that can be computed.

    Args:
        metrics: by name.
        image: ``(1, 3, H, W)`` scene-linear radiance.
        reference: of the same shape.
        previous: image and reference of the previous frame; without them temporal metrics are skipped.
        skipped: receives the reason for each metric that these images, or this installation, do not allow.
    """
    values = {}
    for name, metric in metrics.items():
        try:
            if not metric.temporal:
                values[name] = float(metric.function(image, reference))
            elif previous is not None:
                clip, truth = torch.stack([previous[0], image], 1), torch.stack([previous[1], reference], 1)
                values[name] = float(metric.function(clip, truth))
        except UncomputableError as error:
            if skipped is not None:
                skipped[name] = str(error)
    return values


@dataclass
class Scores:
    """Values of metrics frame by frame; of the images it stores only the last one.

    Args:
        frames: values by frame number and metric; a temporal metric is listed at the later frame of its pair.
        skipped: reasons why a metric could not be computed, or not for every frame.
    """

    frames: dict[int, dict[str, float]] = field(default_factory=dict)
    skipped: dict[str, str] = field(default_factory=dict)
    _last: tuple[int, Tensor, Tensor] | None = field(default=None, init=False)

    def add(self, metrics: Mapping[str, Metric], number: int, image: Tensor, reference: Tensor) -> None:
        """Compute the metrics of the next frame; temporal ones only if the last one is the frame before it."""
        previous = self._last[1:] if self._last is not None and self._last[0] == number - 1 else None
        self.frames[number] = measure(metrics, image, reference, previous, self.skipped)
        self._last = number, image, reference

    @property
    def columns(self) -> dict[str, list[float]]:
        """The values of each metric, in the order of the frames."""
        columns: dict[str, list[float]] = defaultdict(list)
        for values in self.frames.values():
            for name, value in values.items():
                columns[name].append(value)
        return columns

    @property
    def finite(self) -> dict[str, list[float]]:
        """The columns without infinite values, such as the PSNR of a perfect image."""
        return {name: own for name, own in self.columns.items() if all(map(math.isfinite, own))}

    @property
    def mean(self) -> dict[str, float]:
        """Mean over the frames, by metric."""
        return {name: sum(own) / len(own) for name, own in self.columns.items()}


def check_references(sequence: Sequence) -> None:
    """Check that a sequence has references.

    Raises:
        InputError: the sequence has no references.
    """
    if not sequence.reference_numbers:
        raise InputError(f"{sequence.root}: expected references to compare with, found none; render them")
