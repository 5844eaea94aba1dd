"""The example that renders with the denoiser in the loop, in its smallest form."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch

pytest.importorskip("mitsuba", reason="Mitsuba is not installed")

PATH = Path(__file__).resolve().parents[1] / "examples" / "inverse_rendering.py"


@pytest.fixture(scope="module")
def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("inverse_rendering", PATH)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["inverse_rendering"] = module
    spec.loader.exec_module(module)
    return module


def derivative(example: ModuleType, variant: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the derivatives of the mean radiance of all but the brightest pixels, at two seeds."""
    box = example.Box(variant, 12)
    start = torch.tensor([0.5, 0.4, 0.3])
    found = []
    for seed in (1, 2):
        reflectance = start.clone().requires_grad_()
        image = box(reflectance, seed)
        assert image.shape == (1, 3, 12, 12)
        found.append(torch.autograd.grad(image.clamp_max(2).sum((0, 2, 3)).sum(), reflectance)[0])
    return found[0], found[1]


def test_derivative_of_the_scalar_variant_is_that_of_a_polynomial(example: ModuleType) -> None:
    """With the same random numbers, radiance is a polynomial of the reflectance without constant or negative terms."""
    box = example.Box("scalar_rgb", 12)
    values = torch.stack([box.plain(torch.full((3,), x), 1, seed=3) for x in (0.1, 0.2, 0.4, 0.8)])
    # Every pixel grows, and the faster, the larger the reflectance is: all coefficients are non-negative.
    slopes = (values[1:] - values[:-1]) / torch.tensor([0.1, 0.2, 0.4]).reshape(-1, 1, 1, 1, 1)
    assert (slopes >= -1e-5).all()
    assert (slopes[1:] >= slopes[:-1] - 1e-4 * slopes[1:].abs() - 1e-5).all()
    first, second = derivative(example, "scalar_rgb")
    assert (first > 0).all()
    assert (second > 0).all()


def test_descent_with_and_without_the_denoiser(
    example: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    found = example.compare("scalar_rgb", size=16, steps=12, seeds=1, samples=64)
    for errors in found.values():
        assert len(errors) == 1
        assert len(errors[0]) in (7, 13)
    # A dozen steps from 0.3 towards 0.7 and 0.9 already come closer with either loss, where there is little noise.
    for loss in example.LOSSES:
        assert found[loss, "denoised"][0][-1] < found[loss, "denoised"][0][0]
    example.plot(found, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 0
    assert capsys.readouterr().out.count("error") == 5


def test_derivative_of_mitsuba_is_the_same_in_the_mean(example: ModuleType) -> None:
    from mcdenoise.scenes.render.loading import LLVM, first_working

    if first_working(("llvm_ad_rgb",)) is None:
        pytest.skip(LLVM)
    scalar, own = (torch.stack(derivative(example, variant)) for variant in ("scalar_rgb", "llvm_ad_rgb"))
    # The mean of 288 paths is known to a quarter.
    assert ((own.mean(0) / scalar.mean(0)).log().abs() < 0.7).all()
