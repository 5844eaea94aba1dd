"""Clean references: noise goes, and what a denoiser would take away with it stays."""

from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.data.shards import open_shard, write_shard
from mcdenoise.errors import InputError
from mcdenoise.train import clean_references
from mcdenoise.train.references import cleaned

SIDE = 64
PLAIN = torch.full((1, 3, SIDE, SIDE), 0.2)
CHECKS = PLAIN * (1 + 0.8 * torch.tensor([[1.0, -1.0], [-1.0, 1.0]]).repeat(SIDE // 2, SIDE // 2))


def blurred(image: Tensor) -> Tensor:
    return F.avg_pool2d(F.pad(image, [4] * 4, mode="reflect"), 9, 1)


def halves(truth: Tensor, noise: float) -> tuple[Tensor, Tensor]:
    g = torch.Generator().manual_seed(0)
    first, second = (truth * (1 + noise * torch.randn(truth.shape, generator=g)) for _ in range(2))
    return first, second


def error(image: Tensor, truth: Tensor) -> float:
    return float((image - truth).square().mean().sqrt())


@pytest.mark.parametrize(("truth", "most"), [(PLAIN, 0.35), (CHECKS, 1.05)], ids=["plain", "checks"])
def test_noise_goes_where_the_halves_agree_that_it_is_noise(truth: Tensor, most: float) -> None:
    first, second = halves(truth, 0.1)
    found = cleaned(first, second, blurred)
    assert error(found, truth) < most * error((first + second) / 2, truth)
    assert error(blurred(CHECKS), CHECKS) > 5 * error(found, truth)


def test_it_keeps_the_mean_of_equal_halves_and_black() -> None:
    assert torch.equal(cleaned(CHECKS, CHECKS, blurred), CHECKS)
    assert not cleaned(0 * PLAIN, 0 * PLAIN, blurred).any()


def test_a_firefly_in_one_half_does_not_keep_the_noise_around_it() -> None:
    first, second = halves(PLAIN, 0.1)
    first[..., 32, 32] = 2000.0
    found = cleaned(first, second, lambda image: blurred(image.clamp_max(0.4)))
    assert error(found[..., 24:31, 24:31], PLAIN[..., 24:31, 24:31]) < 0.01


def test_a_take_is_copied_with_clean_references(tmp_path: Path) -> None:
    pytest.importorskip("pyoidn", reason="Open Image Denoise is in the extra mcdenoise[peers]")
    truth = PLAIN[0].numpy()
    first, second = (half[0].numpy() for half in halves(PLAIN, 0.3))
    arrays = {name: np.stack([truth] * 4) for name in ("color", "albedo", "normal")}
    arrays |= {"reference": (first + second)[None] / 2, "reference_error": (first - second)[None] / 2}
    source, out = tmp_path / "7.take.npz", tmp_path / "clean"
    write_shard(source, {"number": 7, "credits": []}, arrays)
    copy = open_shard(clean_references(source, out))
    assert copy.path == out / source.name
    found = copy.read()
    assert found.keys() == arrays.keys() - {"reference_error"}
    assert np.array_equal(found["color"], arrays["color"].astype(np.float16))
    reference = torch.from_numpy(found["reference"].astype(np.float32))
    assert error(reference, PLAIN) < 0.2 * error((halves(PLAIN, 0.3)[0] + halves(PLAIN, 0.3)[1]) / 2, PLAIN)
    written = copy.path.stat().st_mtime_ns
    assert clean_references(source, out).stat().st_mtime_ns == written
    # Rendered anew, with another reference alone.
    write_shard(source, {"number": 7, "credits": []}, arrays | {"reference": 2 * arrays["reference"]})
    again = open_shard(clean_references(source, out)).read()["reference"]
    assert again.mean() == pytest.approx(2 * found["reference"].mean(), rel=0.05)
    with pytest.raises(InputError, match=r"7\.take\.npz: expected a copy with clean references"):
        clean_references(source, tmp_path)
    with pytest.raises(InputError, match=r"7\.take\.npz: expected a take with reference_error"):
        clean_references(copy.path, tmp_path / "again")
