"""Evaluation of a method on a sequence, without files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from mcdenoise.data import Sequence, open_sequence, read_exr, write_exr
from mcdenoise.denoiser import Denoiser
from mcdenoise.errors import InputError
from mcdenoise.evaluate import evaluate_folder, evaluate_method
from mcdenoise.folder import denoise_sequence
from mcdenoise.frame import Frame
from mcdenoise.metrics import smape_linear, temporal_rmse_srgb
from mcdenoise.models import Accumulated, Needs, Output


def same(color: Tensor) -> Tensor:
    return color


class Counting:
    """Counts the frames of a shot."""

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


def test_errors_are_means_over_the_frames(sequence: Sequence) -> None:
    done: list[int] = []
    result = evaluate_method(sequence, Denoiser(same), "nothing", on_frame=done.append)
    assert done == [0, 1, 2, 3]
    assert result.as_json()["images"] == "nothing"
    strict = result.tables["strict"]
    frames = [sequence.frame(number) for number in sequence.numbers]
    color, reference = (torch.cat([getattr(frame, name) for frame in frames]) for name in ("color", "reference"))
    assert strict.mean["SMAPE"] == pytest.approx(float(smape_linear(color, reference).mean()), rel=1e-5)
    assert strict.mean["tRMSE"] == pytest.approx(float(temporal_rmse_srgb(color, reference)), rel=1e-5)
    assert (strict.counts["SMAPE"], strict.counts["tRMSE"]) == (4, 3)


def test_the_errors_are_those_of_the_files_that_would_be_written(sequence: Sequence, tmp_path: Path) -> None:
    denoiser = Denoiser(Accumulated(same))
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


def test_a_bad_frame_is_named(small_sequence: Path) -> None:
    path = small_sequence / "inputs" / "albedo1.exr"
    pixels: Any = read_exr(path)[0]
    pixels[3, 4] = float("nan")
    write_exr(path, pixels, ["R", "G", "B"], full_float=True)
    with pytest.raises(InputError, match="frame 1: buffer 'albedo'"):
        evaluate_method(open_sequence(small_sequence), Denoiser(same), "nothing")
