"""Noise of the references themselves, and the error that a perfect result has because of it."""

from __future__ import annotations

import json
import math
from collections.abc import Collection

import torch

from mcdenoise.data import Sequence
from mcdenoise.errors import InputError
from mcdenoise.evaluate.scores import METRICS, Scores
from mcdenoise.reading import read_text

_NOISE_EPSILON = 0.01


def reference_noise(sequence: Sequence) -> float | None:
    """Mean noise of the references, as recorded by the renderer.

    Returns:
        The mean over the frames of ``reference_noise`` in ``camera.json``: the renderer's estimate of the references'
        own SMAPE against the truth. ``None`` if it is not recorded.
    """
    noise = _recorded_noise(sequence)
    return sum(noise.values()) / len(noise) if noise else None


@torch.inference_mode()
def noise_floor(sequence: Sequence, *, metrics: Collection[str] = ("SMAPE", "tSMAPE", "tRMSE")) -> dict[str, float]:
    """Score of the truth itself against references as noisy as these. Lower errors do not distinguish methods.

    This is an estimate: it scores the references, taken as the truth, against copies of them with added noise. The
    noise is Gaussian with the standard deviation ``s sqrt(pi / 2) (2 y + 0.01)``, where ``s`` is the recorded SMAPE of
    the frame, and independent in each pixel, channel and frame. Real noise is uneven and has outliers: in the room of
    the demonstration, with 32 samples per pixel, SMAPE, tSMAPE and tRMSE are estimated 13 to 21 % too low. RMSE cannot
    be estimated in this way, because bright emitters, which have no noise, would get the most.

    Args:
        sequence: frames with references.
        metrics: names in :data:`METRICS`.

    Returns:
        Mean by metric, over the frames or pairs of successive frames whose noise is recorded; empty if there are none.
        Metrics that cannot be computed are skipped.
    """
    scores, chosen = Scores(), {name: METRICS[name] for name in metrics}
    for number, smape in _recorded_noise(sequence).items():
        truth = sequence.reference(number)
        generator = torch.Generator().manual_seed(number)
        deviation = smape * math.sqrt(math.pi / 2) * (2 * truth + _NOISE_EPSILON)
        noisy = (truth + deviation * torch.randn(truth.shape, generator=generator)).clamp_min(0)
        scores.add(chosen, number, truth, noisy)
    return scores.mean


def _recorded_noise(sequence: Sequence) -> dict[int, float]:
    """Noise of each reference in use, if ``camera.json`` records it."""
    for path in (sequence.root / "camera.json", sequence.root / "inputs" / "camera.json"):
        if path.is_file():
            try:
                found = json.loads(read_text(path)).get("reference_noise")
            except (OSError, ValueError, AttributeError, RecursionError):
                # The file belongs to another program: in mcdenoise's layout it has been parsed before.
                return {}
            if found is None:
                return {}
            estimates = {number: found.get(str(number)) for number in sequence.reference_numbers if type(found) is dict}
            for noise in estimates.values() if type(found) is dict else [found]:
                if noise is not None and not (type(noise) in (int, float) and 0 <= noise < math.inf):
                    raise InputError(
                        f"{path}: expected 'reference_noise' to have numbers of 0 or more, found {str(noise)[:80]}"
                    )
            return {number: float(noise) for number, noise in estimates.items() if noise is not None}
    return {}
