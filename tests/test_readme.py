"""What the README shows must run as it stands there."""

import re
from pathlib import Path

import pytest
import torch

from mcdenoise.cli import COMMANDS

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", README, re.S)


@pytest.mark.parametrize("block", BLOCKS, ids=[str(i) for i in range(len(BLOCKS))])
def test_python_block_runs(block):
    torch.manual_seed(0)
    exec(block, {})


def test_composed_denoiser_keeps_a_constant_image():
    namespace: dict = {}
    exec(next(block for block in BLOCKS if "def denoise" in block), namespace)
    color, ones = torch.full((1, 3, 9, 13), 0.3), torch.ones(1, 1, 9, 13)
    normal, albedo = torch.zeros(1, 3, 9, 13), torch.rand(1, 3, 9, 13) * 0.5 + 0.5
    image, light, length = namespace["denoise"](
        color * albedo, albedo, normal, ones, color, ones, torch.zeros(1, 2, 9, 13)
    )
    torch.testing.assert_close(image, color * albedo)
    torch.testing.assert_close(light, color)
    assert length.unique().tolist() == [2.0]


def test_every_command_is_in_the_table():
    named = set(re.findall(r"`mcdenoise ([a-z]+)", README))
    assert named >= set(COMMANDS)
    assert named <= set(COMMANDS)


def test_every_local_link_exists():
    root = Path(__file__).parent.parent
    targets = [t for t in re.findall(r"\]\(([^)#]+)\)", README) if "://" not in t]
    assert targets
    assert [t for t in targets if not (root / t).exists()] == []
