"""Progressive references: halves, and the remaining noise."""

from pathlib import Path

import numpy as np
import pytest
import torch

from mcdenoise.errors import InputError
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


def test_saved_and_loaded(tmp_path: Path) -> None:
    halves = ReferenceHalves(np.zeros((PIXELS, 3)))
    for mean in passes(3, 16):
        halves.add(mean, 16)
    path = tmp_path / "reference0.partial.npz"
    halves.save(path)
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]
    found = ReferenceHalves.load(path, (PIXELS, 1))
    assert (found.paths, found.passes, found.noise()) == (halves.paths, halves.passes, halves.noise())
    np.testing.assert_array_equal(found.mean(), halves.mean())
    with pytest.raises(InputError, match="unfinished"):
        ReferenceHalves.load(path, (PIXELS, 2))
    # The header of an array is read by Python's tokenizer, for which a bracket has to be closed.
    unclosed = path.read_bytes().replace(b"{'descr'", b"{{{descr", 1)
    for content in (path.read_bytes()[:-9], unclosed, b""):
        path.write_bytes(content)
        with pytest.raises(InputError, match="unfinished"):
            ReferenceHalves.load(path, (PIXELS, 1))
