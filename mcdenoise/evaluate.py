"""Errors of every way to denoise a sequence, against its references."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from kornia.filters import joint_bilateral_blur
from torch import Tensor

from mcdenoise.buffers import Frame
from mcdenoise.data.sequences import Sequence
from mcdenoise.denoise import denoised_frames
from mcdenoise.denoiser import Denoiser, Images
from mcdenoise.errors import InputError
from mcdenoise.metrics import psnr_srgb, relmse_linear, smape_linear
from mcdenoise.models import normalize_depth
from mcdenoise.ops import demodulate, remodulate

# The sweep of the plain filter: on nine 1-spp sequences, a step further on every side lowers the best SMAPE of one by
# 0.8 %, and of no other.
_SIGMA_COLOR = (0.05, 0.1, 0.2, 0.3, 0.5)
_SIGMA_SPACE = (1.5, 2.5, 4.0, 6.0)
# Depths in [0, 1] differ by much less than albedos and normals do: without a scale of its own, depth hardly guides.
_DEPTH_SCALE = 10.0

METRICS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "SMAPE": smape_linear,
    "relMSE": relmse_linear,
    "PSNR": psnr_srgb,
}
_HIGHER_IS_BETTER = {"PSNR"}


@dataclass(frozen=True)
class Score:
    """Mean errors of one method on one sequence.

    Args:
        sequence: name of the sequence.
        method: what made the images.
        frames: number of frames in the mean.
        values: mean over the frames, by metric: ``SMAPE`` and ``relMSE`` (scene-linear, lower is better), ``PSNR``
            (as displayed, dB, higher is better).
    """

    sequence: str
    method: str
    frames: int
    values: dict[str, float]


class Scorer:
    """Scores of the noisy, accumulated, initial and denoised images of a sequence, and of the best plain filter.

    The plain filter is ``kornia.filters.joint_bilateral_blur`` of the same accumulated and demodulated input, guided
    by albedo, normal and depth; of a sweep over 20 settings, up to windows of 25x25 pixels, the best one is taken, for
    each metric by itself and by the reference, which favours the filter.

    Args:
        name: of the sequence.
        sweep: whether to run the plain filter.
    """

    def __init__(self, name: str, *, sweep: bool = False) -> None:
        self.name, self.sweep = name, sweep
        self._values: dict[str, list[dict[str, float]]] = {}
        self._swept: dict[str, list[dict[str, float]]] = {}

    def add(self, frame: Frame, images: Images) -> None:
        """Score one frame; one without a reference is left out."""
        if frame.reference is None:
            return
        reference = frame.reference.to(images.noisy.device)
        for method in ("noisy", "accumulated", "initial", "denoised"):
            self._values.setdefault(method, []).append(_score(getattr(images, method), reference))
        if self.sweep:
            for settings, image in _joint_bilateral(frame.to(images.noisy.device), images):
                self._swept.setdefault(settings, []).append(_score(image, reference))

    def scores(self) -> list[Score]:
        """The mean over the frames so far, from the noisy to the denoised image."""
        means = {method: _mean(values) for method, values in self._values.items()}
        if self._swept:
            swept = [_mean(values) for values in self._swept.values()]
            means["joint bilateral, best"] = {
                metric: (max if metric in _HIGHER_IS_BETTER else min)(mean[metric] for mean in swept)
                for metric in METRICS
            }
        order = ("noisy", "accumulated", "joint bilateral, best", "initial", "denoised")
        frames = len(self._values.get("noisy", ()))
        return [Score(self.name, method, frames, means[method]) for method in order if method in means]


def score_sequence(sequence: Sequence, denoiser: Denoiser, *, sweep: bool = True) -> list[Score]:
    """Denoise a sequence and score it, see :class:`Scorer`.

    Args:
        sequence: frames with references.
        denoiser: is reset first.
        sweep: whether to run the plain filter.

    Raises:
        InputError: the sequence has no references, or a buffer has invalid values.
    """
    if not sequence.reference_numbers:
        raise InputError(f"{sequence.root}: expected references to compare with, found none; render them")
    scorer = Scorer(sequence.name, sweep=sweep)
    for frame, images in denoised_frames(sequence, denoiser):
        scorer.add(frame, images)
    return scorer.scores()


def _score(image: Tensor, reference: Tensor) -> dict[str, float]:
    return {name: float(metric(image, reference)) for name, metric in METRICS.items()}


def _mean(values: list[dict[str, float]]) -> dict[str, float]:
    return {name: sum(value[name] for value in values) / len(values) for name in values[0]}


@torch.inference_mode()
def _joint_bilateral(frame: Frame, images: Images) -> Iterable[tuple[str, Tensor]]:
    """Every setting of the sweep and its image."""
    frame, _ = frame.validate()
    guides = [x for x in (frame.albedo, frame.normal) if x is not None]
    if frame.depth is not None:
        guides.append(normalize_depth(frame.depth) * _DEPTH_SCALE)
    albedo = torch.ones_like(images.noisy) if frame.albedo is None else frame.albedo
    image = demodulate(images.accumulated, albedo)
    # With nothing to guide it, the filter is a plain bilateral one.
    guide = torch.cat(guides or [image], 1)
    for color, space in itertools.product(_SIGMA_COLOR, _SIGMA_SPACE):
        size = 2 * math.ceil(2 * space) + 1
        blurred = joint_bilateral_blur(
            image, guide, size, color, (space, space), border_type="replicate", color_distance_type="l2"
        )
        yield f"{color} {space}", remodulate(blurred, albedo)
