"""Evaluation of a method on a sequence, without files."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from mcdenoise.data import Sequence, open_sequence
from mcdenoise.denoiser import Denoiser
from mcdenoise.evaluate import evaluate_folder, evaluate_method
from mcdenoise.folder import denoise_sequence
from mcdenoise.frame import Frame
from mcdenoise.models import Accumulated, Needs, Output


class Counting:
    needs = Needs(trainable=False)

    def __init__(self) -> None:
        self.seen: list[int] = []

    def __call__(self, frame: Frame, state: Tensor | None = None) -> tuple[Output, Tensor]:
        count = torch.ones(1) if state is None else state + 1
        self.seen.append(int(count))
        return Output(frame.color), count


@pytest.fixture
def sequence(small_sequence: Path) -> Sequence:
    return open_sequence(small_sequence)


def test_the_errors_are_those_of_the_files_that_would_be_written(sequence: Sequence, tmp_path: Path) -> None:
    denoiser = Denoiser(Accumulated(lambda color: color))
    denoise_sequence(sequence, tmp_path / "out", denoiser, "accumulated", full_float=True)
    written = evaluate_folder(sequence, tmp_path / "out", protocol="meng2020")
    found = evaluate_method(sequence, denoiser, "accumulated", protocol="meng2020")
    for name, table in written.tables.items():
        assert found.tables[name].mean == pytest.approx(table.mean, rel=1e-6)
    assert found.warping_error == pytest.approx(written.warping_error)


def test_a_method_sees_frames_without_a_reference_too(small_sequence: Path) -> None:
    (small_sequence / "inputs" / "reference1.exr").unlink()
    model = Counting()
    result = evaluate_method(open_sequence(small_sequence), Denoiser(model), "counting")
    assert model.seen == [1, 2, 3, 4]
    assert result.tables["strict"].counts["SMAPE"] == 3
