"""What the README shows must run as it stands there."""

import re
from pathlib import Path

import pytest
import torch

from mcdenoise.cli import COMMANDS

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", README, re.S)


def namespace_of(part: str) -> dict:
    """What the block that contains ``part`` defines when it is run."""
    namespace: dict = {}
    exec(next(block for block in BLOCKS if part in block), namespace)
    return namespace


@pytest.mark.parametrize("block", BLOCKS, ids=[str(i) for i in range(len(BLOCKS))])
def test_python_block_runs(block: str) -> None:
    torch.manual_seed(0)
    exec(block, {})


def test_the_streaming_example_has_a_history() -> None:
    report = namespace_of("denoiser = Denoiser")["denoiser"].report
    assert (report.reset, report.missing, report.replaced_pixels) == ("", [], 0)


def test_the_composed_denoiser_denoises() -> None:
    """Uniform light, a wall before the sky: less noise after each step, nothing invalid."""
    denoise, g = namespace_of("def denoise")["denoise"], torch.Generator().manual_seed(0)
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


def test_every_command_is_in_the_table():
    named = set(re.findall(r"`mcdenoise ([a-z]+)", README))
    assert named >= set(COMMANDS)
    assert named <= set(COMMANDS)


def test_every_local_link_exists():
    root = Path(__file__).parent.parent
    targets = [t for t in re.findall(r"\]\(([^)#]+)\)", README) if "://" not in t]
    assert targets
    assert [t for t in targets if not (root / t).exists()] == []
