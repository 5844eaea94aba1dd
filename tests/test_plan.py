"""What is left out of whole sequences, on the command line and in files."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from mcdenoise.denoise import denoise_sequence
from torch import nn

from mcdenoise import Denoiser, create_model
from mcdenoise.cli import main
from mcdenoise.data import open_sequence


def small_model() -> nn.Module:
    """A small cascade with random weights, also in the heads that start at zero."""
    torch.manual_seed(0)
    model = create_model("cascaded", width=8)
    for head in model.first.heads:
        nn.init.normal_(head.weight, std=0.02)
    return model


def test_the_command_line_prints_and_writes_the_plan(
    small_sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plans = {}
    for name, options in (("short", ["--tolerance", "0.01"]), ("whole", ["--keep-all"])):
        out = tmp_path / name
        command = ["denoise", str(small_sequence), "-o", str(out), "--model", "cascaded_tiny", "--frames", "2"]
        with pytest.raises(SystemExit) as stop:
            main([*command, *options])
        assert stop.value.code == 0
        plans[name] = json.loads((out / "denoise.json").read_text())
        printed = capsys.readouterr().out
        if name == "short":
            assert "  remember: left out (one frame)\n" in printed
        assert "  demodulate: kept (albedo)\n" in printed
    assert (plans["short"]["tolerance"], plans["short"]["keep_all"], plans["whole"]["keep_all"]) == (0.01, False, True)
    kept = {name: {row["stage"]: row["kept"] for row in plan["plan"]} for name, plan in plans.items()}
    assert (kept["short"]["remember"], kept["whole"]["remember"]) == (False, True)
    images = [(tmp_path / name / "denoised2.exr").read_bytes() for name in plans]
    assert images[0] == images[1]


def test_a_sequence_and_its_frames_one_by_one_are_the_same(small_sequence: Path, tmp_path: Path) -> None:
    sequence = open_sequence(small_sequence)
    report = denoise_sequence(sequence, tmp_path / "out", Denoiser(small_model()), "small")
    assert [row["stage"] for row in report.plan][:2] == ["read", "accumulate"]
    assert {row["stage"]: row["left_out"] for row in report.plan}["remember"] == pytest.approx(1 / 4)
