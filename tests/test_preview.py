"""Images for people to look at: known codes, one exposure for all frames, a video of all of them."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from commands import refuses, succeeds
from pictures import frames_of

from mcdenoise.data import read_exr
from mcdenoise.data.png import Picture, read_png
from mcdenoise.preview import Preview


def code(radiance: float) -> int:
    """8-bit code of a radiance by IEC 61966-2-1, written out."""
    x = min(max(radiance, 0.0), 1.0)
    return round(255 * (12.92 * x if x <= 0.0031308 else 1.055 * x ** (1 / 2.4) - 0.055))


def shown(folder: Path, name: str) -> Picture:
    return read_png(folder / "preview" / f"{name}.png")


@pytest.mark.parametrize("stops", [-3.0, 0.0, 1.5])
def test_codes_are_those_of_the_curve(tmp_path: Path, stops: float) -> None:
    radiance = torch.linspace(-0.1, 2, 300).expand(1, 3, 150, 300).clone()
    radiance[:, 1] *= 0.5
    preview = Preview(tmp_path, video=False, exposure=stops)
    preview.add("ramp", radiance)
    picture = shown(tmp_path, "ramp")
    assert picture.shape == (150, 300, 3)
    expected = [[code(float(radiance[0, c, 0, x]) * 2**stops) for c in range(3)] for x in range(300)]
    # In float32 a radiance on the border of two codes may fall to either side.
    assert np.abs(picture.astype(int) - np.array(expected)).max() <= 1
    assert (picture == np.array(expected)).mean() > 0.99


def test_the_first_frame_that_is_not_black_decides_the_exposure_of_all(tmp_path: Path) -> None:
    preview = Preview(tmp_path, video=False)
    for name, radiance in {"a": 0.0, "b": 2.0, "c": 4.0, "d": 1.0, "e": 0.0}.items():
        preview.add(name, torch.full((1, 3, 20, 24), radiance))
    codes = [int(shown(tmp_path, name)[0, 0, 0]) for name in "abcde"]
    assert codes == [0, code(0.18), code(0.36), code(0.09), 0]


def test_other_primaries_are_converted(tmp_path: Path, colour: Any) -> None:
    space = colour.RGB_COLOURSPACES["ITU-R BT.2020"]
    stated = tuple(float(x) for x in [*space.primaries.flatten(), *space.whitepoint])
    color = np.array([0.2, 0.5, 0.3])
    image = torch.from_numpy(color).float().reshape(3, 1, 1).expand(3, 8, 8)
    preview = Preview(tmp_path, video=False, exposure=0.0)
    preview.add("wide", image, {"chromaticities": stated})
    to_srgb = colour.matrix_RGB_to_RGB(space, colour.RGB_COLOURSPACES["sRGB"], "Bradford")
    assert shown(tmp_path, "wide")[3, 3].tolist() == [code(x) for x in to_srgb @ color]


def test_the_video_has_the_pictures_in_their_order(tmp_path: Path) -> None:
    ramp = torch.linspace(0.05, 0.6, 64).expand(1, 3, 48, 64)
    preview = Preview(tmp_path, exposure=0.0)
    # Gaps are no matter; neither is the order of the names.
    names = ["frame_0001", "frame_0007", "frame_0003", "shot.0010"]
    for number, name in enumerate(names):
        preview.add(name, ramp * (1 + 0.5 * number))
    assert not (tmp_path / "preview.mp4").exists()
    steps: list[int] = []
    preview.close(on_frame=lambda: steps.append(1))
    frames = frames_of(tmp_path / "preview.mp4")
    assert len(frames) == len(steps) == 4
    for name, frame in zip(names, frames, strict=True):
        # The next frame is brighter by 15 codes and more.
        assert np.abs(frame.astype(float) - shown(tmp_path, name)).mean() < 3
    pictures = [tmp_path / "preview" / f"{name}.png" for name in names]
    assert preview.written == [*pictures, tmp_path / "preview.mp4"]


def test_the_command_line(small_sequence: Path, out: Path) -> None:
    command, settings = (
        f"denoise {small_sequence} -o {out} --model accumulated",
        "--preview-fps 12 --preview-exposure -1",
    )
    preview, results = succeeds(f"{command} --preview {settings} --full-float").splitlines()[-2:]
    assert preview == f"preview: {out / 'preview.mp4'}"
    assert results.endswith(f"{out / 'denoised0.exr'} to denoised3.exr")
    assert len(frames_of(out / "preview.mp4")) == 4
    for number in range(4):
        radiance = read_exr(out / f"denoised{number}.exr")[0]
        expected = [code(float(x) / 2) for x in radiance.ravel()]
        assert np.abs(shown(out, f"denoised{number}").ravel() - np.array(expected)).max() <= 1
    assert "show" in json.loads((out / "denoise.json").read_text())["beside"]
    preview = succeeds(f"{command} --preview --frames 2").splitlines()[-2]
    assert preview == f"preview: {out / 'preview' / 'denoised2.png'}"
    assert not (out / "preview.mp4").exists()


def test_the_command_line_refuses_before_it_denoises(
    small_sequence: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = f"denoise {small_sequence} -o {out} --model accumulated"
    assert "expected together with --preview" in refuses(f"{command} --preview-fps 12")
    assert "frames per second" in refuses(f"{command} --preview --preview-fps 0")
    monkeypatch.setitem(sys.modules, "av", None)
    assert "mcdenoise[preview]" in refuses(f"{command} --preview")
    assert not out.exists()
    succeeds(f"{command} --preview --frames 1")


def test_a_damaged_frame_leaves_no_video(small_sequence: Path, out: Path) -> None:
    color = small_sequence / "inputs" / "color2.exr"
    color.write_bytes(color.read_bytes()[:-300])
    refuses(f"denoise {small_sequence} -o {out} --model accumulated --preview")
    files = {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}
    assert files == {f"{name}" for n in (0, 1) for name in (f"denoised{n}.exr", f"preview/denoised{n}.png")}
