"""How far the references themselves are from the truth, and what that costs a perfect result."""

from __future__ import annotations

import json
import math
from collections.abc import Collection

import torch

from mcdenoise.data import Sequence
from mcdenoise.errors import InputError
from mcdenoise.evaluate.scores import METRICS, measure
from mcdenoise.reading import read_text

_NOISE_EPSILON = 0.01


def reference_noise(sequence: Sequence) -> float | None:
    """How noisy the references themselves are: the mean over the frames of what the renderer has noted.

    Returns:
        The mean of ``reference_noise`` in ``camera.json``, by frame number: the references' own SMAPE against the
        truth, as estimated by the renderer. ``None`` where nothing is noted.
    """
    noise = _noted(sequence)
    return sum(noise.values()) / len(noise) if noise else None


@torch.inference_mode()
def noise_floor(sequence: Sequence, *, metrics: Collection[str] = ("SMAPE", "tSMAPE", "tRMSE")) -> dict[str, float]:
    """What the truth itself would score against references as noisy as these: no method can be told from it there.

    An estimate: the references are taken for the truth, and copies of them with the noise that the renderer has noted
    for the references. The noise is Gaussian, its standard deviation ``s sqrt(pi / 2) (2 y + 0.01)``, where ``s`` is
    the noted SMAPE of the frame, independent in each pixel, channel and frame. Real noise is uneven and has outliers:
    in the demonstration's room, with 32 paths a pixel, SMAPE, tSMAPE and tRMSE come out 13 to 21 % too low. RMSE is not
    to be had in this way: bright emitters, which have no noise, would get the most.

    Args:
        sequence: frames with references.
        metrics: names in :data:`METRICS`.

    Returns:
        Mean over the frames, or pairs of successive frames, whose noise is noted, by metric; empty where none is. What
        cannot be computed is skipped.
    """
    values: dict[str, list[float]] = {}
    past = None
    noise = _noted(sequence)
    for number, smape in noise.items():
        truth = sequence.reference(number)
        generator = torch.Generator().manual_seed(number)
        deviation = smape * math.sqrt(math.pi / 2) * (2 * truth + _NOISE_EPSILON)
        noisy = (truth + deviation * torch.randn(truth.shape, generator=generator)).clamp_min(0)
        chosen = {name: METRICS[name] for name in metrics}
        for name, value in measure(chosen, truth, noisy, past if number - 1 in noise else None).items():
            values.setdefault(name, []).append(value)
        past = truth, noisy
    return {name: sum(own) / len(own) for name, own in values.items()}


def _noted(sequence: Sequence) -> dict[int, float]:
    """Noise of each reference in use, where ``camera.json`` has it."""
    for path in (sequence.root / "camera.json", sequence.root / "inputs" / "camera.json"):
        if path.is_file():
            try:
                noted = json.loads(read_text(path)).get("reference_noise")
            except (OSError, ValueError, AttributeError, RecursionError):
                # Somebody else's: that of a folder in our layout has been read before.
                return {}
            if noted is None:
                return {}
            estimates = {number: noted.get(str(number)) for number in sequence.reference_numbers if type(noted) is dict}
            for noise in estimates.values() if type(noted) is dict else [noted]:
                if noise is not None and not (type(noise) in (int, float) and 0 <= noise < math.inf):
                    raise InputError(
                        f"{path}: expected 'reference_noise' to have numbers of 0 or more, found {str(noise)[:80]}"
                    )
            return {number: float(noise) for number, noise in estimates.items() if noise is not None}
    return {}
