"""Evaluation of a method on a sequence, without files."""

from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from pictures import part_of
from toys import Watching

from mcdenoise.data import Sequence, open_sequence
from mcdenoise.denoiser import Denoiser
from mcdenoise.evaluate import evaluate_folder, evaluate_method
from mcdenoise.folder import denoise_sequence
from mcdenoise.models import Accumulated


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


def test_files_with_windows_of_their_own_are_compared_where_they_are(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for number, place in enumerate([(2, 4), (6, 0)]):
        pixels = np.random.default_rng(number).random((6, 16, 20), dtype=np.float32)
        names = (*"RGB", "reference.R", "reference.G", "reference.B")
        part = part_of(dict(zip(names, pixels, strict=True)), place=place, display=(32, 32))
        OpenEXR.File([part]).write(str(tmp_path / f"in/shot_{number}.exr"))
    sequence, denoiser = open_sequence(tmp_path / "in"), Denoiser("noisy")
    denoise_sequence(sequence, tmp_path / "out", denoiser, "noisy", full_float=True)
    written, found = evaluate_folder(sequence, tmp_path / "out"), evaluate_method(sequence, denoiser, "noisy")
    assert found.tables["strict"].mean == pytest.approx(written.tables["strict"].mean, rel=1e-6)


def test_a_method_sees_frames_without_a_reference_too(small_sequence: Path) -> None:
    (small_sequence / "inputs" / "reference1.exr").unlink()
    model = Watching()
    result = evaluate_method(open_sequence(small_sequence), Denoiser(model), "watching")
    assert [state is None for state in model.states] == [True, False, False, False]
    assert result.tables["strict"].counts["SMAPE"] == 3
