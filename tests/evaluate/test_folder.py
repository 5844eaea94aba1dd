"""Evaluation of a folder of images: finding files, values, and rejected input."""

from __future__ import annotations

import json
import math
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mcdenoise.data import open_sequence, read_exr, write_exr
from mcdenoise.data.readers.bmfr import write_bmfr_frame
from mcdenoise.errors import InputError
from mcdenoise.evaluate import METRICS, USUAL, evaluate_folder, find_images, measure, noise_floor
from mcdenoise.metrics import PROTOCOLS, displayed, flicker_srgb, warped_rmse_srgb, warping_error_srgb
from mcdenoise.metrics.protocols import ProtocolName
from mcdenoise.ops import Surface, motion_from_position

RGB = ["R", "G", "B"]


def touched(folder: Path, *names: str) -> Path:
    folder.mkdir(exist_ok=True)
    for name in names:
        (folder / name).touch()
    return folder


@pytest.fixture
def images(small_sequence: Path, tmp_path: Path) -> Path:
    """A folder with the noisy colors as its images."""
    out = tmp_path / "out"
    out.mkdir()
    for number in range(4):
        shutil.copy(small_sequence / "inputs" / f"color{number}.exr", out / f"denoised{number}.exr")
    return out


def changed(path: Path, change: Callable[[np.ndarray[Any, Any]], object]) -> None:
    pixels, channels, _ = read_exr(path)
    change(pixels)
    write_exr(path, pixels, channels, full_float=True)


# Finding files


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
        (("v1_f2.exr",), r"found v1_f2.exr; keep only one series"),
        (("mask.exr",), "names that differ in one number, that of the frame"),
        (("f1.exr", "f01.exr", "f2.exr"), r"one file a frame, found f01.exr and f1.exr"),
        (("f1.exr", "f3.exr"), r"found none of frame 2 \(it has frames 1 to 3\); .* --frames"),
        (tuple(f"denoised{i}.exr" for i in range(100, 103)), r"found none of frame 1, 2 \(it has frames 100 to 102\)"),
    ],
)
def test_names_without_a_frame_number_are_rejected(tmp_path: Path, names: tuple[str, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        find_images(touched(tmp_path / "out", *names), [1, 2])


def test_no_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        find_images(tmp_path / "nowhere", [1])
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="found a file"):
        find_images(tmp_path / "file", [1])


# Values


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
        assert frame.reference is not None
        usual = {name: METRICS[name] for name in USUAL}
        assert found == pytest.approx(measure(usual, frame.color, frame.reference, previous), rel=1e-6)
        if number == 0:
            assert warped is None
            continue
        before = frames[number - 1]
        assert frame.position is not None
        assert before.view_projection is not None
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
    stored = json.loads(json.dumps(result.as_json(), allow_nan=False))
    assert stored["protocols"]["strict"]["mean"]["PSNR"] is None
    assert stored["protocols"]["strict"]["frames"]["2"]["SSIM"] == 1


@pytest.mark.parametrize("protocol", ["meng2020", "fan2021"])
def test_a_protocol_is_listed_beside_strict(small_sequence: Path, images: Path, protocol: ProtocolName) -> None:
    sequence = open_sequence(small_sequence)
    tables = evaluate_folder(sequence, images, protocol=protocol).tables
    assert list(tables) == ["strict", protocol]
    frame = sequence.frame(2)
    assert frame.reference is not None
    expected = measure(PROTOCOLS[protocol].metrics, frame.color, frame.reference)
    assert tables[protocol].frames[2] == pytest.approx(expected, rel=1e-6)
    assert list(tables[protocol].frames) == [0, 1, 2, 3]
    # For the same images, the data range of 2 makes the SSIM higher.
    assert tables[protocol].mean["SSIM"] > tables["strict"].mean["SSIM"]


def test_noisebase_skips_the_first_frames(small_sequence: Path, images: Path) -> None:
    pytest.importorskip("flip_evaluator")
    tables = evaluate_folder(open_sequence(small_sequence), images, protocol="noisebase").tables
    assert tables["noisebase"].frames == {}
    assert "skips the first 16 frames" in tables["noisebase"].skipped["PSNR"]
    assert "pyfvvdp" in tables["noisebase"].skipped["FVVDP"]
    assert len(tables["strict"].frames) == 4


def long_sequence(folder: Path, frames: int) -> tuple[Path, Path]:
    """A static shot whose noisy colors are also its denoised images: the folders of both."""
    generator = torch.Generator().manual_seed(0)
    root, out = folder / "static", folder / "still"
    out.mkdir()
    reference = torch.rand(1, 3, 20, 24, generator=generator)
    one = open_sequence(next(folder.glob("plane"))).frame(0)
    for number in range(frames):
        color = (reference + 0.1 * torch.randn(reference.shape, generator=generator)).clamp_min(0)
        still = torch.zeros(1, 2, 20, 24)
        frame = one.replace(color=color, reference=reference, motion=still, view_projection=None)
        write_bmfr_frame(root / "inputs", number, frame)
        shutil.copy(root / "inputs" / f"color{number}.exr", out / f"frame.{number:04d}.exr")
    return root, out


def test_flicker_of_a_static_shot(small_sequence: Path, tmp_path: Path) -> None:
    pytest.importorskip("flip_evaluator")
    sequence, images = (open_sequence(path) if i == 0 else path for i, path in enumerate(long_sequence(tmp_path, 19)))
    result = evaluate_folder(sequence, images, protocol="noisebase")
    strict, noisebase = result.tables.values()
    frames = [sequence.frame(number) for number in range(19)]
    clip, truth = (torch.stack([getattr(frame, name) for frame in frames], 1) for name in ("color", "reference"))
    assert strict.mean["flicker"] == pytest.approx(float(flicker_srgb(clip, truth)), rel=1e-5)
    assert strict.mean["flicker"] > 0.05
    assert strict.counts["flicker"] == 19
    # Without motion, warping changes nothing.
    assert strict.mean["wRMSE"] == pytest.approx(strict.mean["tRMSE"], rel=1e-4)
    # 16 frames are skipped; the first of the rest has no previous frame.
    assert list(noisebase.frames) == [16, 17, 18]
    assert {name: noisebase.counts[name] for name in ("PSNR", "tPSNR")} == {"PSNR": 3, "tPSNR": 2}
    assert "160 x 160" in noisebase.skipped["MS-SSIM"]


def test_the_flicker_of_two_shots_is_computed_separately(small_sequence: Path, tmp_path: Path) -> None:
    root, images = long_sequence(tmp_path, 7)
    # From frame 4 on, everything has moved.
    changed(root / "inputs" / "motion4.exr", lambda pixels: pixels.fill(3.0))
    for number in (4, 5, 6):
        changed(images / f"frame.{number:04d}.exr", lambda pixels: pixels.fill(0.5))
    sequence = open_sequence(root)
    strict = evaluate_folder(sequence, images).tables["strict"]
    frames = [sequence.frame(number) for number in range(7)]
    clip, truth = (torch.stack([getattr(frame, name) for frame in frames], 1) for name in ("color", "reference"))
    first = float(flicker_srgb(clip[:, :4], truth[:, :4]))
    # The second shot does not change at all.
    assert strict.mean["flicker"] == pytest.approx(first * 4 / 7, rel=1e-4)
    assert strict.counts["flicker"] == 7


def test_frames_that_are_not_successive_are_no_pair(small_sequence: Path, images: Path) -> None:
    (small_sequence / "inputs" / "reference1.exr").unlink()
    table = evaluate_folder(open_sequence(small_sequence), images).tables["strict"]
    assert list(table.frames) == [0, 2, 3]
    assert table.counts["tSMAPE"] == table.counts["wRMSE"] == 1
    table = evaluate_folder(open_sequence(small_sequence, "0-2"), images).tables["strict"]
    assert {name for name in table.skipped if name != "flicker"} == {"tSMAPE", "tRMSE", "wRMSE"}
    assert table.skipped["tRMSE"] == "no two successive frames with references"


def test_without_motion_nothing_is_warped(small_sequence: Path, images: Path) -> None:
    (small_sequence / "inputs" / "camera_matrices.h").unlink()
    result = evaluate_folder(open_sequence(small_sequence), images)
    assert "no motion" in result.tables["strict"].skipped["wRMSE"]
    assert "tRMSE" in result.tables["strict"].mean
    assert result.warping_error is None


def test_without_flip_the_rest_is_there(small_sequence: Path, images: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    table = evaluate_folder(open_sequence(small_sequence), images).tables["strict"]
    assert "pip install" in table.skipped["FLIP"]
    assert "pip install" in table.skipped["HDR-FLIP"]
    assert {"SMAPE", "PSNR", "SSIM"} <= set(table.mean)


def test_primaries_of_the_images_are_converted(small_sequence: Path, images: Path, colour: Any) -> None:
    """References converted to ACEScg score like the references themselves."""
    spaces = colour.RGB_COLOURSPACES
    matrix = colour.matrix_RGB_to_RGB(spaces["sRGB"], spaces["ACEScg"], chromatic_adaptation_transform="Bradford")
    primaries = (*spaces["ACEScg"].primaries.flatten().tolist(), *spaces["ACEScg"].whitepoint.tolist())
    for number in range(4):
        pixels, _, _ = read_exr(small_sequence / "inputs" / f"reference{number}.exr")
        path = images / f"denoised{number}.exr"
        write_exr(path, pixels @ matrix.T, RGB, full_float=True, metadata={"chromaticities": primaries})
    assert evaluate_folder(open_sequence(small_sequence), images).tables["strict"].mean["SMAPE"] < 1e-3


# The references' own noise


def test_the_truth_scores_the_noise_of_the_references(small_sequence: Path, images: Path) -> None:
    sequence = open_sequence(small_sequence)
    assert noise_floor(sequence) == {}
    described = small_sequence / "inputs" / "camera.json"

    def noted(noise: float) -> dict[str, float]:
        content = {"color_includes_albedo": True, "reference_noise": dict.fromkeys("0123", noise)}
        described.write_text(json.dumps(content))
        return noise_floor(sequence)

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
    assert noted(0.0) == {"SMAPE": 0, "tSMAPE": 0, "tRMSE": 0}
    result = evaluate_folder(sequence, images)
    assert result.reference_noise == 0
    assert result.floor["tRMSE"] == 0


# Rejected input


def test_a_sequence_without_references_is_rejected(small_sequence: Path, images: Path) -> None:
    for path in (small_sequence / "inputs").glob("reference*.exr"):
        path.unlink()
    with pytest.raises(InputError, match="references"):
        evaluate_folder(open_sequence(small_sequence), images)


def test_pixels_that_are_not_finite_are_counted(small_sequence: Path, images: Path) -> None:
    def spoil(pixels: np.ndarray[Any, Any]) -> None:
        pixels[5, 7, 1] = np.nan
        pixels[6, 2] = np.inf

    changed(images / "denoised2.exr", spoil)
    with pytest.raises(InputError, match=r"denoised2.exr: .*2 .* of 480, .* row 5, column 7"):
        evaluate_folder(open_sequence(small_sequence), images)


@pytest.mark.parametrize(
    ("shape", "channels", "message"),
    [
        ((20, 23, 3), RGB, "expected 24 x 20 pixels like the sequence, found 23 x 20"),
        ((20, 24, 3), ["albedo.R", "albedo.G", "albedo.B"], "expected noisy radiance, found albedo.RGB"),
        ((20, 24, 6), [f"{eye}.{c}" for eye in ("left", "right") for c in RGB], "found left.RGB, right.RGB"),
    ],
)
def test_images_of_another_kind(
    small_sequence: Path, images: Path, shape: tuple[int, ...], channels: list[str], message: str
) -> None:
    write_exr(images / "denoised3.exr", np.zeros(shape), channels)
    with pytest.raises(InputError, match=rf"denoised3.exr: .*{message}"):
        evaluate_folder(open_sequence(small_sequence), images)


def test_a_damaged_image(small_sequence: Path, images: Path) -> None:
    path = images / "denoised1.exr"
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(InputError, match=r"denoised1.exr:"):
        evaluate_folder(open_sequence(small_sequence), images)
