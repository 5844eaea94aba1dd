"""The claims of the README are true, and the examples of the pages that it leads to run."""

import re
from pathlib import Path

import pytest
import torch
from commands import run, succeeds
from test_docs import blocks

from mcdenoise.check.cases import OPS
from mcdenoise.data import read_exr
from mcdenoise.models import list_models

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
RESEARCHERS = ROOT / "docs" / "for-researchers.md"


def code_with(page: Path, part: str) -> dict:
    """Return the names that the block of a page that contains ``part`` defines when it is run."""
    namespace: dict = {}
    exec(next(block for block in blocks(page, "python") if part in block), namespace)
    return namespace


def test_its_counts_are_true() -> None:
    operators, models = re.search(r"than (\d+)\s+image\s+operators.*?zoo of some (\d+)", README, re.DOTALL).groups()
    assert int(operators) < len(OPS)
    assert abs(int(models) - len(list_models())) <= 5


@pytest.mark.parametrize("page", ["README.md", "docs/for-engines.md", "docs/for-researchers.md"])
def test_the_example_has_a_history(page: str) -> None:
    report = code_with(ROOT / page, "denoiser = Denoiser")["denoiser"].report
    assert (report.reset, report.missing, report.replaced_pixels) == ("", [], 0)


def test_the_composed_example_does_what_is_promised(
    tmp_path: Path, small_sequence: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is trained, and with its weights it denoises and is measured."""
    pytest.importorskip("lightning_fabric", reason="training needs the packages of mcdenoise[train]")
    monkeypatch.chdir(tmp_path)
    write_composed(tmp_path)

    small = "--steps 2 --crop 16 --frames 2 --batch 1 --validation-frames 0"
    succeeds(f"train {small_sequence} -o run --model mine.py:network {small}")
    status, _, said = run(f"denoise {small_sequence} -o out --model mine.py:network --weights run/network.safetensors")
    assert status == 0
    assert "random" not in said
    pixels = [read_exr(path)[0] for path in sorted((tmp_path / "out").glob("*.exr"))]
    assert len(pixels) == 4
    assert all((image >= 0).all() for image in pixels)
    measured = "mine.py:network(weights=run/network.safetensors)"
    settings = "--precisions float32 --sizes none --rounds 1"
    succeeds(f"benchmark {small_sequence} -o results --models {measured} {settings}")


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_composed_example_is_exported_and_stable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_composed(tmp_path)
    succeeds("export mine.py:network -o mine.pt2")
    succeeds("stability --models mine.py:network --frames 5 --dtypes float32")


def write_composed(folder: Path) -> None:
    block = next(block for block in blocks(RESEARCHERS, "python") if "def network" in block)
    (folder / "mine.py").write_text(block.partition("\ndenoiser = ")[0])


def test_the_composed_denoiser_denoises() -> None:
    """Uniform light, a wall before the sky: less noise after each step, nothing invalid."""
    denoise, g = code_with(RESEARCHERS, "def denoise")["denoise"], torch.Generator().manual_seed(0)
    size = (15, 21)
    albedo = torch.rand(1, 3, *size, generator=g) * 0.5 + 0.25
    normal, depth = torch.zeros(1, 3, *size), torch.full((1, 1, *size), 4.0)
    normal[:, 2], depth[:, :, :5], normal[:, :, :5] = 1, torch.inf, 0
    previous, length, surface = torch.zeros(1, 3, *size), torch.ones(1, 1, *size), None
    for frame in range(4):
        noise = -torch.log(torch.rand(1, 3, *size, generator=g).clamp_min(1e-6))  # mean 1, as of a lucky path
        motion = torch.full((1, 2, *size), torch.inf if frame == 0 else 0.0)
        image, previous, length, surface = denoise(
            noise * albedo, albedo, normal, depth, motion, previous, length, surface
        )
        assert image.isfinite().all()
    assert length.unique().tolist() == [4.0]
    error, accumulated = ((x - 1).square().mean() for x in (image / albedo, previous))
    assert error < 0.3 * accumulated < 0.3 * 0.35
