"""Evaluation of a folder of images: finding files, values, and rejected input."""

import json
import math
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pictures import edit
from refusals import refused

from mcdenoise.data import open_sequence
from mcdenoise.data.files import json_text
from mcdenoise.evaluate import METRICS, USUAL, evaluate_folder, find_images, measure
from mcdenoise.metrics import displayed, warped_rmse_srgb, warping_error_srgb
from mcdenoise.ops import Surface, motion_from_position


def touched(folder: Path, *names: str) -> Path:
    folder.mkdir(exist_ok=True)
    for name in names:
        (folder / name).touch()
    return folder


@pytest.fixture
def images(small_sequence: Path, tmp_path: Path) -> Path:
    out = tmp_path / "out"
    out.mkdir()
    for number in range(4):
        shutil.copy(small_sequence / "inputs" / f"color{number}.exr", out / f"denoised{number}.exr")
    return out


@pytest.mark.parametrize(
    "names",
    [
        ("denoised8.exr", "denoised9.exr", "denoised10.exr"),
        ("frame.0008.exr", "frame.0009.exr", "frame.0010.exr"),
        ("8.exr", "9.exr", "10.exr", "notes.txt"),
        ("shot02_v3.0008.beauty.exr", "shot02_v3.0009.beauty.exr", "shot02_v3.0010.beauty.exr"),
        # Files of mcdenoise, beside other files.
        ("denoised8.exr", "denoised9.exr", "denoised10.exr", "mask.exr", "albedo9.exr", ".denoised9.5.tmp.exr"),
    ],
)
def test_frames_are_found_by_their_number(tmp_path: Path, names: tuple[str, ...]) -> None:
    found = find_images(touched(tmp_path / "out", *names), [8, 9, 10])
    assert [path.name for path in found.values()] == list(names[:3])
    assert list(found) == [8, 9, 10]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ((), "expected denoised EXR images, found none"),
        (("a1.exr", "b2.exr"), r"names that differ in one number, that of the frame.*found a1.exr, b2.exr"),
        (("a1_1.exr", "a2_2.exr"), "names that differ in one number, that of the frame"),
        (("mask.exr",), "found none of frame 1, 2"),
        (("f1.exr", "f01.exr", "f2.exr"), r"one file a frame, found f01.exr"),
        (("f1.exr", "f3.exr"), r"found none of frame 2 \(it has frames 1 to 3\); .* --frames"),
        (tuple(f"denoised{i}.exr" for i in range(100, 103)), r"found none of frame 1, 2 \(it has frames 100 to 102\)"),
    ],
)
def test_names_without_a_frame_number_are_rejected(tmp_path: Path, names: tuple[str, ...], message: str) -> None:
    assert re.search(message, refused(find_images, touched(tmp_path / "out", *names), [1, 2]))


def test_every_value_is_that_of_its_function(small_sequence: Path, images: Path) -> None:
    pytest.importorskip("flip_evaluator")
    sequence = open_sequence(small_sequence)
    done: list[int] = []
    result = evaluate_folder(sequence, images, on_frame=done.append)
    assert done == [0, 1, 2, 3]
    assert list(result.tables) == ["strict"]
    table = result.tables["strict"]
    frames = [sequence.frame(number) for number in range(4)]
    clip, truth = (torch.stack([getattr(frame, name) for frame in frames], 1) for name in ("color", "reference"))
    warping = []
    for number, frame in enumerate(frames):
        previous = None if number == 0 else (clip[:, number - 1], truth[:, number - 1])
        found = dict(table.frames[number])
        assert 0 < found.pop("HDR-FLIP") < 1
        warped = found.pop("wRMSE", None)
        usual = {name: METRICS[name] for name in USUAL}
        assert found == pytest.approx(measure(usual, frame.color, frame.reference, previous), rel=1e-6)
        if number == 0:
            assert warped is None
            continue
        before = frames[number - 1]
        pair = slice(number - 1, number + 1)
        along = (
            motion_from_position(frame.position, before.view_projection),
            Surface(frame.position, frame.normal, frame.depth),
            Surface(before.position, before.normal, before.depth),
        )
        assert warped == pytest.approx(float(warped_rmse_srgb(clip[:, pair], truth[:, pair], *along)), rel=1e-6)
        warping.append([float(warping_error_srgb(x[:, pair], *along)) for x in (clip, truth)])
    smape = [values["SMAPE"] for values in table.frames.values()]
    assert table.mean["SMAPE"] == pytest.approx(sum(smape) / 4)
    assert table.counts["SMAPE"] == 4
    assert table.counts["tRMSE"] == table.counts["wRMSE"] == 3
    assert result.warping_error == pytest.approx(np.mean(warping, 0).tolist(), rel=1e-6)
    # The floor and the sky change less than the noise.
    assert np.mean(warping, 0)[0] > 5 * np.mean(warping, 0)[1]
    assert "without motion" in table.skipped["flicker"]
    assert (result.reference_noise, result.floor) == (None, {})


def test_references_are_perfect(small_sequence: Path, images: Path) -> None:
    pytest.importorskip("flip_evaluator")
    for number in range(4):
        shutil.copy(small_sequence / "inputs" / f"reference{number}.exr", images / f"denoised{number}.exr")
    result = evaluate_folder(open_sequence(small_sequence), images)
    mean = result.tables["strict"].mean
    assert mean.pop("PSNR") == math.inf
    assert mean.pop("SSIM") == 1
    assert set(mean.values()) == {0}
    stored = json.loads(json_text(result.as_json()))
    assert stored["protocols"]["strict"]["mean"]["PSNR"] is None
    assert stored["protocols"]["strict"]["frames"]["2"]["SSIM"] == 1


def test_frames_that_are_not_successive_are_no_pair(small_sequence: Path, images: Path) -> None:
    (small_sequence / "inputs" / "reference1.exr").unlink()
    table = evaluate_folder(open_sequence(small_sequence), images).tables["strict"]
    assert list(table.frames) == [0, 2, 3]
    assert table.counts["tSMAPE"] == table.counts["wRMSE"] == 1
    table = evaluate_folder(open_sequence(small_sequence, "0-2"), images).tables["strict"]
    assert {name for name in table.skipped if name != "flicker"} == {"tSMAPE", "tRMSE", "wRMSE"}
    assert table.skipped["tRMSE"] == "no two successive frames with references"


def test_the_truth_scores_the_noise_of_the_references(small_sequence: Path, images: Path) -> None:
    sequence = open_sequence(small_sequence)
    described = small_sequence / "inputs" / "camera.json"

    def noted(noise: float) -> dict[str, float]:
        content = {"color_includes_albedo": True, "reference_noise": dict.fromkeys("0123", noise)}
        described.write_text(json.dumps(content))
        return evaluate_folder(sequence, images).floor

    one, two = noted(0.01), noted(0.02)
    # This holds by construction; 5760 values estimate it to 1 %.
    assert one["SMAPE"] == pytest.approx(0.01, rel=0.04)
    assert two["SMAPE"] == pytest.approx(0.02, rel=0.04)
    # The change from frame to frame has the noise of both frames, and is proportional to it below white.
    assert two["tRMSE"] == pytest.approx(2 * one["tRMSE"], rel=0.1)
    references = torch.cat([sequence.frame(number).reference for number in range(4)])
    deviation = 0.01 * math.sqrt(math.pi / 2) * (2 * references + 0.01)
    slope = (displayed(references + 1e-3) - displayed(references - 1e-3)) / 2e-3
    squares = (slope * deviation).square().mean((1, 2, 3))
    expected = (squares[1:] + squares[:-1]).sqrt().mean()
    assert one["tRMSE"] == pytest.approx(float(expected), rel=0.05)
    still = noted(0.0)
    assert still["SMAPE"] == still["tSMAPE"] == still["tRMSE"] == 0
    assert evaluate_folder(sequence, images).reference_noise == 0


def test_a_sequence_without_references_is_rejected(small_sequence: Path, images: Path) -> None:
    for path in (small_sequence / "inputs").glob("reference*.exr"):
        path.unlink()
    assert "references" in refused(evaluate_folder, open_sequence(small_sequence), images)


def test_pixels_that_are_not_finite_are_counted(small_sequence: Path, images: Path) -> None:
    def spoil(pixels: np.ndarray[Any, Any]) -> None:
        pixels[5, 7, 1] = np.nan
        pixels[6, 2] = np.inf

    edit(images / "denoised2.exr", spoil)
    told = refused(evaluate_folder, open_sequence(small_sequence), images)
    assert re.search(r"denoised2.exr: .*2 .* of 480, .* row 5, column 7", told)
