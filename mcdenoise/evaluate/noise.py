"""Noise of the references themselves, which a perfect result seems to have."""

from __future__ import annotations

import json
import math

import torch
from torch import Tensor

from mcdenoise.data import Sequence
from mcdenoise.errors import InputError
from mcdenoise.reading import read_text

_NOISE_EPSILON = 0.01


def reference_noise(sequence: Sequence) -> float | None:
    """Mean noise of the references, as recorded by the renderer, see :func:`recorded_noise`; ``None`` if it is not."""
    noise = recorded_noise(sequence).values()
    return sum(noise) / len(noise) if noise else None


def as_noisy(truth: Tensor, smape: float, seed: int) -> Tensor:
    """A copy of a reference with noise, whose score against it tells that of the truth against such a reference.

    Lower errors do not distinguish methods. This is an estimate: the noise is Gaussian with the standard deviation
    ``s sqrt(pi / 2) (2 y + 0.01)``, where ``s`` is the recorded SMAPE of the frame, and independent in each pixel,
    channel and frame. Real noise is uneven and has outliers: in the room of the demonstration, with 32 samples per
    pixel, SMAPE, tSMAPE and tRMSE are estimated 13 to 21 % too low. RMSE cannot be estimated in this way, because
    bright emitters, which have no noise, would get the most.

    Args:
        truth: ``(1, 3, H, W)`` y, the reference.
        smape: s.
        seed: of the noise.
    """
    generator = torch.Generator().manual_seed(seed)
    deviation = smape * math.sqrt(math.pi / 2) * (2 * truth + _NOISE_EPSILON)
    return (truth + deviation * torch.randn(truth.shape, generator=generator)).clamp_min(0)


def recorded_noise(sequence: Sequence) -> dict[int, float]:
    """The renderer's estimate of each reference's own SMAPE against the truth, by number, if ``camera.json`` has any.

    Raises:
        InputError: the file has something else in its place.
    """
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
