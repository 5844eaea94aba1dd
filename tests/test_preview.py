"""Images for people to look at: known codes, one exposure for all frames, a video of all of them."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from mcdenoise.cli import main
from mcdenoise.data import read_exr
from mcdenoise.data.png import Picture, read_png
from mcdenoise.errors import InputError
from mcdenoise.preview import Preview


def code(radiance: float) -> int:
    """8-bit code of a radiance by IEC 61966-2-1, written out."""
    x = min(max(radiance, 0.0), 1.0)
    return round(255 * (12.92 * x if x <= 0.0031308 else 1.055 * x ** (1 / 2.4) - 0.055))


def constant(radiance: float, height: int = 20, width: int = 24) -> Tensor:
    return torch.full((1, 3, height, width), radiance)


def shown(folder: Path, name: str) -> Picture:
    return read_png(folder / "preview" / f"{name}.png")


def frames_of(path: Path) -> list[Picture]:
    av = pytest.importorskip("av")
    with av.open(path) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def test_middle_grey_is_code_118(tmp_path: Path) -> None:
    assert code(0.18) == 118
    for name, radiance in {"dark": 3e-6, "grey": 0.18, "bright": 4e5}.items():
        preview = Preview(tmp_path, video=False)
        preview.add(name, constant(radiance))
        assert (shown(tmp_path, name) == 118).all()
        assert preview.exposure == pytest.approx(math.log2(0.18 / radiance), abs=1e-4)


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
        preview.add(name, constant(radiance))
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


def test_a_still_has_no_video_and_an_old_one_goes(tmp_path: Path) -> None:
    (tmp_path / "preview.mp4").write_bytes(b"of an earlier run")
    preview = Preview(tmp_path)
    preview.add("still", constant(1.0))
    preview.close()
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["preview", "still.png"]


def test_an_interrupted_preview_leaves_whole_pictures_and_no_video(tmp_path: Path) -> None:
    preview = Preview(tmp_path)
    preview.add("0", constant(1.0))
    preview.add("1", constant(1.0, width=30))
    with pytest.raises(InputError, match=r"preview\.mp4:"):
        preview.close()
    (tmp_path / "preview" / "1.png").write_bytes((tmp_path / "preview" / "0.png").read_bytes()[:-40])
    with pytest.raises(InputError, match=r"1\.png:"):
        preview.close()
    (tmp_path / "preview" / "2.png").mkdir()
    with pytest.raises(InputError, match=r"2\.png:"):
        preview.add("2", constant(1.0))
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["0.png", "1.png", "2.png", "preview"]


def test_something_in_the_way_of_the_folder(tmp_path: Path) -> None:
    (tmp_path / "preview").write_text("a file")
    with pytest.raises(InputError, match="preview:"):
        Preview(tmp_path).add("0", constant(1.0))


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"frames_per_second": 0.0}, "frames per second: expected 1 to 1000, found 0"),
        ({"exposure": math.nan}, "exposure: expected -100 to 100 stops, found nan"),
        ({"exposure": 1000.0}, "exposure: expected -100 to 100 stops, found 1000"),
    ],
)
def test_settings_that_cannot_be(tmp_path: Path, settings: dict[str, float], expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        Preview(tmp_path, **settings)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


def test_without_the_package_pictures_are_written_and_a_video_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match=r"av.*mcdenoise\[preview\]"):
        Preview(tmp_path)
    Preview(tmp_path, video=False).add("0", constant(1.0))
    assert shown(tmp_path, "0").shape == (20, 24, 3)


def run(sequence: Path, out: Path, *options: str) -> int:
    """Exit status of `mcdenoise denoise` with a method that needs no time."""
    with pytest.raises(SystemExit) as stop:
        main(["denoise", str(sequence), "-o", str(out), "--model", "accumulated", *options])
    return int(stop.value.code or 0)


def test_the_command_line(small_sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert run(small_sequence, out, "--preview", "--preview-fps", "12", "--preview-exposure", "-1", "--full-float") == 0
    preview, results = capsys.readouterr().out.splitlines()[-2:]
    assert preview == f"preview: {out / 'preview.mp4'}"
    assert results.endswith(f"{out / 'denoised0.exr'} to denoised3.exr")
    assert len(frames_of(out / "preview.mp4")) == 4
    for number in range(4):
        radiance = read_exr(out / f"denoised{number}.exr")[0]
        expected = [code(float(x) / 2) for x in radiance.ravel()]
        assert np.abs(shown(out, f"denoised{number}").ravel() - np.array(expected)).max() <= 1
    assert "show" in json.loads((out / "denoise.json").read_text())["beside"]
    assert run(small_sequence, out, "--preview", "--frames", "2") == 0
    assert capsys.readouterr().out.splitlines()[-2] == f"preview: {out / 'preview' / 'denoised2.png'}"
    assert not (out / "preview.mp4").exists()


def test_the_command_line_refuses_before_it_denoises(
    small_sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    assert run(small_sequence, out, "--preview-fps", "12") == 2
    assert "expected together with --preview" in capsys.readouterr().err
    assert run(small_sequence, out, "--preview", "--preview-fps", "0") == 2
    assert "frames per second" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "av", None)
    assert run(small_sequence, out, "--preview") == 2
    assert "mcdenoise[preview]" in capsys.readouterr().err
    assert not out.exists()
    # A still needs no package.
    assert run(small_sequence, out, "--preview", "--frames", "1") == 0


def test_a_damaged_frame_leaves_no_video(small_sequence: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    color = small_sequence / "inputs" / "color2.exr"
    color.write_bytes(color.read_bytes()[:-300])
    assert run(small_sequence, out, "--preview") == 2
    files = {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}
    assert files == {f"{name}" for n in (0, 1) for name in (f"denoised{n}.exr", f"preview/denoised{n}.png")}


_MEMORY = """
import resource, sys
from pathlib import Path
import torch
from mcdenoise.heap import keep_heap
from mcdenoise.preview import Preview
keep_heap()
torch.set_num_threads(1)
preview = Preview(Path(sys.argv[1]), video=False)
frame = torch.rand(1, 3, 45, 80).repeat_interleave(8, 2).repeat_interleave(8, 3)
def peak(count):
    for _ in range(count):
        preview.add(f"frame{len(preview.written)}", frame)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
before = peak(60)
print((peak(180) - before) / frame.numel())
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="reads the peak of memory through the POSIX resource usage")
def test_memory_does_not_grow_with_the_number_of_frames(tmp_path: Path) -> None:
    result = subprocess.run([sys.executable, "-c", _MEMORY, str(tmp_path)], capture_output=True, text=True, check=True)
    # In pictures. What stays of each, be it a note in a cache that keeps a hole in the heap, makes it 100 and more.
    assert float(result.stdout) < 30
