"""Progressive references: halves, and the remaining noise."""

import numpy as np
import pytest
import torch

from mcdenoise.metrics import smape_linear
from mcdenoise.scenes.render.halves import ReferenceHalves

PIXELS = 4000


def passes(count: int, paths: int, seed: int = 0) -> list[np.ndarray]:
    """Means of so many paths with a relative standard deviation of 1, around a mean that differs by pixel."""
    rng = np.random.default_rng(seed)
    truth = np.linspace(0.1, 4, PIXELS * 3).reshape(PIXELS, 3)
    return [truth * rng.gamma(paths, 1 / paths, truth.shape) for _ in range(count)]


@pytest.mark.parametrize("start", [0, 16, 200])
def test_noise_is_the_smape_against_the_truth(start: int) -> None:
    """This holds with equal halves, and where one half is all that there was before."""
    before = passes(1, start, seed=1)[0] if start else np.zeros((PIXELS, 3))
    halves = ReferenceHalves(before, start, start)
    for mean in passes(6, 16):
        halves.add(mean, 16)
    truth = np.linspace(0.1, 4, PIXELS * 3).reshape(PIXELS, 3)
    images = (torch.from_numpy(image.T.reshape(3, 1, PIXELS)) for image in (halves.mean(), truth))
    noise = halves.noise()
    # Measured: within 1 %.
    np.testing.assert_allclose(noise, smape_linear(*images).item(), rtol=0.03)
    assert (halves.spp, halves.passes) == (start + 96, start + 6)
