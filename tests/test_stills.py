"""Single images on the command line: a file in, a file out in any format; and an image compared with a reference."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
import torch
from commands import refuses, run, succeeds
from numpy.typing import NDArray
from pictures import as_channels, part_of

from mcdenoise import denoise
from mcdenoise.data import open_sequence, read_exr, write_exr
from mcdenoise.data.color_space import to_rec709
from mcdenoise.data.files import folder_beside
from mcdenoise.data.radiance import write_radiance
from mcdenoise.interruption import remove_unfinished

SIZE = (24, 32)
# Largest relative error of a format's numbers, and the largest one beside it; half floats have 11 bits, RGBE 8.
ERRORS = {".exr": (2**-11, 0.0), ".pfm": (1e-6, 0.0), ".hdr": (0.0, 2**-7), ".tif": (0.0, 1e-4), ".png": (0.0, 5e-3)}


def read(path: Path) -> NDArray[Any]:
    opened = open_sequence(path)
    return opened.frame(opened.numbers[0]).color[0].permute(1, 2, 0).numpy()


@pytest.fixture
def buffers(tmp_path: Path) -> dict[str, NDArray[Any]]:
    rng = np.random.default_rng(0)
    albedo = np.where(np.arange(SIZE[1]) < 16, 0.2, 0.8)[None, :, None] * np.ones((*SIZE, 3))
    normal = np.broadcast_to(np.float32([0.6, 0, -0.8]), (*SIZE, 3))
    found = {"x": 0.9 * albedo * rng.random((*SIZE, 3)), "y": albedo, "z": normal}
    found = {name: np.ascontiguousarray(image, np.float32) for name, image in found.items()}
    for name, image in found.items():
        write_radiance(tmp_path / f"{name}.pfm", image)
    return found


@pytest.mark.parametrize("ending", ERRORS)
def test_a_file_is_denoised_to_a_file_of_any_format(
    ending: str, buffers: dict[str, NDArray[Any]], tmp_path: Path
) -> None:
    out = tmp_path / "new" / f"clean{ending}"
    features = ["--albedo", tmp_path / "y.pfm", "--normal", tmp_path / "z.pfm"]
    succeeds("denoise", tmp_path / "x.pfm", *features, "--model", "joint_bilateral", "-o", out)
    assert [each.name for each in out.parent.iterdir()] == [out.name]
    expected = denoise(buffers["x"], albedo=buffers["y"], normal=buffers["z"], model="joint_bilateral")
    relative, absolute = ERRORS[ending]
    np.testing.assert_allclose(read(out), expected, rtol=relative, atol=absolute)


def test_an_albedo_may_be_grey_and_a_normal_not(buffers: dict[str, NDArray[Any]], tmp_path: Path) -> None:
    grey, out = tmp_path / "grey.pfm", tmp_path / "out.pfm"
    write_radiance(grey, buffers["y"][..., :1])
    noisy = ("denoise", tmp_path / "x.pfm", "-o", out, "--model", "joint_bilateral")
    succeeds(*noisy, "--albedo", grey)
    expected = denoise(buffers["x"], albedo=buffers["y"], model="joint_bilateral")
    np.testing.assert_allclose(read(out), expected, rtol=1e-6)
    assert "grey.pfm: expected channels of the buffer 'normal'" in refuses(*noisy, "--normal", grey)


def test_the_result_is_not_rounded_as_its_input_was(buffers: dict[str, NDArray[Any]], tmp_path: Path) -> None:
    """Nor are files taken for frames of one shot whose names differ in zeros only."""
    noisy, albedo, out = tmp_path / "x_01.png", tmp_path / "x_1.png", tmp_path / "out.pfm"
    write_radiance(noisy, buffers["x"])
    write_radiance(albedo, buffers["y"])
    succeeds("denoise", noisy, "--albedo", albedo, "--model", "joint_bilateral", "-o", out)
    expected = denoise(read(noisy), albedo=read(albedo), model="joint_bilateral")
    np.testing.assert_allclose(read(out), expected, rtol=1e-5)


def test_the_layers_of_a_file_are_kept(buffers: dict[str, NDArray[Any]], tmp_path: Path) -> None:
    noisy, out = tmp_path / "noisy.exr", tmp_path / "clean.exr"
    names = [*"RGB", *("albedo.R", "albedo.G", "albedo.B")]
    write_exr(noisy, np.concatenate([buffers["x"], buffers["y"]], 2), names, full_float=True)
    succeeds("denoise", noisy, "--model", "joint_bilateral", "-o", out)
    pixels, channels, _ = read_exr(out)
    found = {name: pixels[..., channels.index(name)] for name in names}
    np.testing.assert_array_equal(found["albedo.G"], buffers["y"][..., 1])
    expected = denoise(buffers["x"], albedo=buffers["y"], model="joint_bilateral")
    np.testing.assert_allclose(found["G"], expected[..., 1], rtol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("x.pfm", "-o", "x.pfm"), "found the same"),
        (("x.pfm", "--albedo", "y.pfm", "-o", "y.pfm"), "found the same"),
        (("shot_#.pfm", "--frames", "1", "-o", "shot_1.pfm"), "found the same"),
        (("shot_#.pfm", "--frames", "2", "-o", "shot_1.pfm"), "found the same"),
        (("x.pfm", "z.pfm", "--albedo", "y.pfm", "-o", "out.pfm"), "found 2 inputs"),
        (("x.pfm", "--albedo", "none.pfm", "-o", "out.pfm"), "none.pfm"),
        (("x.pfm", "--preview", "-o", "out.pfm"), "found --preview"),
        (("shot_#.pfm", "-o", "out.pfm"), "found 2 frames"),
        (("x.pfm", "-o", "out.JPG"), "found '.JPG'"),
    ],
)
def test_what_cannot_be_one_file_is_refused(
    arguments: tuple[str, ...],
    expected: str,
    buffers: dict[str, NDArray[Any]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    for number in (1, 2):
        write_radiance(Path(f"shot_{number}.pfm"), buffers["x"])
    assert expected in refuses("denoise", *arguments, "--model", "noisy")
    assert not any(Path(name).exists() for name in ("out.pfm", "out.JPG"))
    for name, buffer in (("x", "x"), ("y", "y"), ("shot_1", "x")):
        np.testing.assert_array_equal(read(Path(f"{name}.pfm")), buffers[buffer])


def test_another_format_has_what_the_display_window_shows(buffers: dict[str, NDArray[Any]], tmp_path: Path) -> None:
    channels = as_channels({"": buffers["x"]})
    height, width = buffers["x"].shape[:2]
    part = part_of(channels, place=(-3, -5), display=(height - 6, width - 9))
    OpenEXR.File([part]).write(str(tmp_path / "wide.exr"))
    succeeds("denoise", tmp_path / "wide.exr", "-o", tmp_path / "out.pfm", "--model", "noisy")
    np.testing.assert_array_equal(read(tmp_path / "out.pfm"), buffers["x"][3:-3, 5:-4])


@pytest.mark.parametrize(("layers", "out"), [("parts.exr", "out.exr"), ("parts.exr", "out.pfm"), ("shot.exr", "out")])
def test_layers_in_a_file_of_their_own_are_not_lost(
    layers: str, out: str, buffers: dict[str, NDArray[Any]], tmp_path: Path
) -> None:
    """Neither where one file is written, nor where both would get the same name."""
    files = [tmp_path / "image" / "shot.exr", tmp_path / "layers" / layers]
    for path, prefix in zip(files, ("", "emission."), strict=True):
        path.parent.mkdir()
        write_exr(path, buffers["x"], [f"{prefix}{letter}" for letter in "RGB"])
    assert layers in refuses("denoise", *files, "--layers", "emission", "--model", "noisy", "-o", tmp_path / out)
    assert not list(tmp_path.glob("out*")) or os.listdir(tmp_path / out) == []


def test_a_folder_that_nothing_can_be_written_to_is_refused(buffers: dict[str, NDArray[Any]], tmp_path: Path) -> None:
    out = Path("/proc/clean.pfm")
    assert str(out) in refuses("denoise", tmp_path / "x.pfm", "-o", out, "--model", "noisy")


def test_a_command_that_is_killed_leaves_no_folder_beside_its_file(
    buffers: dict[str, NDArray[Any]], tmp_path: Path
) -> None:
    """A model that is busy in native code hears no signal, so that the process ends without it."""
    with folder_beside(tmp_path / "clean.pfm") as folder:
        (folder / "x.pfm").touch()
        remove_unfinished()
        assert not folder.exists()


def test_an_image_is_compared_with_a_reference(buffers: dict[str, NDArray[Any]], tmp_path: Path) -> None:
    for folder, image in (("a", buffers["y"]), ("b", buffers["y"] + 0.1)):
        (tmp_path / folder).mkdir()
        for number in (1, 2):
            write_radiance(tmp_path / folder / f"{folder}{number}.exr", image)
    # Means of |a - b| / (|a| + |b| + 0.01) over both halves of the image.
    smape, file = (0.1 / 0.51 + 0.1 / 1.71) / 2, tmp_path / "errors.json"
    for where in ("a", "b"), ("a/a1.exr", "b/b2.exr"):
        succeeds("evaluate", *(tmp_path / each for each in where), "--json", file)
        strict = json.loads(file.read_text())["protocols"]["strict"]
        assert strict["mean"]["SMAPE"] == pytest.approx(smape, rel=1e-2)
        assert len(strict["frames"]) == (2 if where == ("a", "b") else 1)
    assert "2 frames" in refuses("evaluate", tmp_path / "a", tmp_path / "b" / "b1.exr")


@pytest.mark.parametrize("ending", [".png", ".tif"])
def test_display_values_are_compared_as_light(ending: str, buffers: dict[str, NDArray[Any]], tmp_path: Path) -> None:
    for name in ("one", "other"):
        write_radiance(tmp_path / f"{name}{ending}", buffers["y"])
    file = tmp_path / "errors.json"
    succeeds("evaluate", tmp_path / f"one{ending}", tmp_path / f"other{ending}", "--json", file)
    assert json.loads(file.read_text())["protocols"]["strict"]["mean"]["SMAPE"] == pytest.approx(0, abs=1e-6)


def test_files_with_layers_are_references(tmp_path: Path) -> None:
    rendered = Path(__file__).parent / "data" / "renderers" / "blender"
    succeeds("denoise", rendered, "-o", tmp_path / "out", "--model", "noisy")
    for where in (rendered, tmp_path / "out"), (rendered / "shot_0001.exr", tmp_path / "out" / "shot_0001.exr"):
        succeeds("evaluate", *where, "--json", tmp_path / "errors.json")
        mean = json.loads((tmp_path / "errors.json").read_text())["protocols"]["strict"]["mean"]
        assert mean["SMAPE"] == pytest.approx(0, abs=1e-3)


def test_pictures_without_features_are_stills_and_no_broken_shot(
    buffers: dict[str, NDArray[Any]], tmp_path: Path
) -> None:
    """Nothing is said about a history where there is no motion to look one up by."""
    for number in (1, 2, 3):
        write_radiance(tmp_path / f"shot_{number}.pfm", buffers["x"] * (1 + number / 8))
    out = tmp_path / "out"
    assert "history" not in succeeds("denoise", tmp_path / "shot_#.pfm", "-o", out, "--model", "wild_small")
    written = json.loads((out / "denoise.json").read_text())
    resets = {frame["reset"] for frame in written["frames"].values()}
    assert resets == {"no motion, and no position with a previous camera"}
    assert written["warnings"] == []


def test_folders_in_a_folder_without_images_are_named(buffers: dict[str, NDArray[Any]], tmp_path: Path) -> None:
    for name in ("beauty", "albedo"):
        (tmp_path / "passes" / name).mkdir(parents=True)
    assert "albedo/, beauty/" in refuses("denoise", tmp_path / "passes", "-o", tmp_path / "out")


def test_light_that_a_format_cannot_hold_is_told(buffers: dict[str, NDArray[Any]], tmp_path: Path) -> None:
    bright = buffers["x"].copy()
    bright[:6] = 4
    write_radiance(tmp_path / "bright.pfm", bright)
    for ending, told in ((".png", "25.0%"), (".tif", "25.0%"), (".exr", "")):
        status, _, said = run("denoise", tmp_path / "bright.pfm", "-o", tmp_path / f"out{ending}", "--model", "noisy")
        assert (status, "clamped" in said) == (0, told != "")
        assert told in said


@pytest.mark.parametrize("ending", [".png", ".pfm"])
def test_other_formats_get_the_primaries_that_they_are_read_in(ending: str, tmp_path: Path) -> None:
    acescg = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)
    green = np.broadcast_to(np.float32([0.3, 0.7, 0.3]), (*SIZE, 3))
    write_exr(tmp_path / "noisy.exr", green, list("RGB"), full_float=True, metadata={"chromaticities": acescg})
    succeeds("denoise", tmp_path / "noisy.exr", "--model", "noisy", "-o", tmp_path / f"clean{ending}")
    expected = to_rec709(torch.from_numpy(green[0, 0].copy())[:, None, None], {"chromaticities": acescg})
    np.testing.assert_allclose(read(tmp_path / f"clean{ending}")[0, 0], expected[:, 0, 0], atol=ERRORS[".png"][1])


def test_layers_before_the_input_are_told_from_it(buffers: dict[str, NDArray[Any]], tmp_path: Path) -> None:
    assert "before --layers" in refuses("denoise", "-o", tmp_path / "out", "--layers", "all", tmp_path / "x.pfm")
