"""The noise of the references themselves, and its effect on the errors of a perfect result."""

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
    """The noise of the references, as estimated and stored by the renderer.

    Returns:
        The mean over the frames of ``reference_noise`` in ``camera.json``: the SMAPE of the references against the
        truth. ``None`` if it is not stored.
    """
    noise = _noted(sequence)
    return sum(noise.values()) / len(noise) if noise else None


@torch.inference_mode()
def noise_floor(sequence: Sequence, *, metrics: Collection[str] = ("SMAPE", "tSMAPE", "tRMSE")) -> dict[str, float]:
    """Estimate the errors that the truth itself would have against these references; smaller errors are meaningless.

    The references are taken as the truth, and compared with copies to which noise of the stored strength is added. The
    noise is Gaussian with the standard deviation ``s sqrt(pi / 2) (2 y + 0.01)``, where ``s`` is the stored SMAPE of
    the frame, independent in each pixel, channel and frame. Real noise is uneven and has outliers: in the
    demonstration's room with 32 paths per pixel, SMAPE, tSMAPE and tRMSE are underestimated by 13 to 21 %. RMSE cannot
    be estimated in this way, because bright emitters, which have no noise, would get the most.

    Args:
        sequence: frames with references.
        metrics: names in :data:`METRICS`.

    Returns:
        Mean by metric over the frames, or pairs of consecutive frames, with stored noise; empty if there are none.
        Metrics that cannot be computed are omitted.
    """
    values: dict[str, list[float]] = {}
    previous = None
    noise = _noted(sequence)
    for number, smape in noise.items():
        truth = sequence.reference(number)
        generator = torch.Generator().manual_seed(number)
        deviation = smape * math.sqrt(math.pi / 2) * (2 * truth + _NOISE_EPSILON)
        noisy = (truth + deviation * torch.randn(truth.shape, generator=generator)).clamp_min(0)
        chosen = {name: METRICS[name] for name in metrics}
        for name, value in measure(chosen, truth, noisy, previous if number - 1 in noise else None).items():
            values.setdefault(name, []).append(value)
        previous = truth, noisy
    return {name: sum(own) / len(own) for name, own in values.items()}


def _noted(sequence: Sequence) -> dict[int, float]:
    """The stored noise of each reference in use."""
    for path in (sequence.root / "camera.json", sequence.root / "inputs" / "camera.json"):
        if path.is_file():
            try:
                noted = json.loads(read_text(path)).get("reference_noise")
            except (OSError, ValueError, AttributeError, RecursionError):
                # A file of another program; that of a folder in our layout has been checked before.
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
