"""A film checks every shot before any work, and its frames once more at the end."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from shots import Inline, edit, same, write_manifest, write_shot

from mcdenoise.cli import main
from mcdenoise.data import Sequence
from mcdenoise.film import Film, FilmResult, read_film, run_film

SHOT = '[[shot]]\nname = "{}"\ninput = "s1"\nframes = "0-1"\n{}\n'
DIGITS = "1" + 5000 * "0"


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    return write_shot(tmp_path / "s1", 5)


def run(shot: Path, out: Path) -> FilmResult:
    manifest = write_manifest(out.parent / "film.toml", {"s1": shot}, model="accumulated")
    return run_film(Film(read_film(manifest), out), Inline())


@pytest.mark.parametrize(
    "setting",
    [
        'model = "oidn_tunde"',
        'model = "mine.py:make"',
        'weights = "nowhere.safetensors"',
        'model = "noisy"\nalpha_min = 0.5',
        'device = "gpu"',
        "tile = 33",
        'budget_ms = 5.0\nresults = "nowhere"',
        "budget_ms = -1",
        "max_memory = inf",
        "preview = true\npreview_fps = nan",
        f"tile = 0x{DIGITS}",
        f"max_memory = {DIGITS}.0",
        f'frames = "{DIGITS}"',
    ],
    ids=lambda setting: setting[:40],
)
def test_a_wrong_setting_of_one_shot_is_found_before_any_other_is_made(
    shot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], setting: str
) -> None:
    manifest = tmp_path / "film.toml"
    wrong = SHOT.format("wrong", setting)
    if "frames" in setting:
        wrong = wrong.replace('frames = "0-1"\n', "")
    manifest.write_text(SHOT.format("right", 'model = "noisy"') + wrong)
    with pytest.raises(SystemExit) as stop:
        main(["film", str(manifest), "-o", str(tmp_path / "out")])
    said = capsys.readouterr()
    assert stop.value.code == 2
    assert said.err.count("\n") == 1
    assert len(said.err) < 2000
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("pattern", ["", "..", "/"])
def test_a_pattern_without_a_name_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], pattern: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        main(["film", pattern, "-o", "out"])
    assert stop.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_the_picked_model_is_told_everywhere(
    shot: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mcdenoise.cli.film.open_engine", lambda workers, **options: Inline())
    manifest = tmp_path / "film.toml"
    manifest.write_text(SHOT.format("any", ""))
    with pytest.raises(SystemExit):
        main(["film", str(manifest), "-o", str(tmp_path / "out")])
    about = json.loads((tmp_path / "out/any/denoise.json").read_text())
    model, _, why = about["picked"].partition(": ")
    assert model == about["model"]
    assert why
    assert json.loads((tmp_path / "out/film.json").read_text())["shots"][0]["picked"] == about["picked"]
    assert about["picked"] in (tmp_path / "out/film.html").read_text()
    assert about["picked"] in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("when", ["before it is read", "after it was read", "after it was denoised"])
def test_a_frame_that_changes_while_the_film_runs_is_made_again(
    shot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    path, read = shot / "inputs/color2.exr", Sequence.frame
    path.write_bytes(path.read_bytes().ljust(20_000))
    status, left = path.stat(), [path]

    def frame(self: Sequence, number: int, **options: Any) -> Any:
        last = number == (4 if "denoised" in when else 2)
        if last and when.startswith("before"):
            change()
        found = read(self, number, **options)
        if last:
            change()
        return found

    def change() -> None:
        while left:
            edit(left.pop())
            # Of the same size; and a copy may keep the time of its source.
            path.write_bytes(path.read_bytes().ljust(20_000))
            os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))

    monkeypatch.setattr(Sequence, "frame", frame)
    result = run(shot, tmp_path / "out")
    monkeypatch.undo()
    assert not left
    assert path.stat().st_size == status.st_size
    assert result.complete
    assert run(shot, tmp_path / "fresh").complete
    assert same(tmp_path / "out/s1", tmp_path / "fresh/s1")
    assert run(shot, tmp_path / "out").made == 0


def test_a_frame_that_changes_all_the_time_is_not_finished(
    shot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, read = shot / "inputs/color4.exr", Sequence.frame

    def frame(self: Sequence, number: int, **options: Any) -> Any:
        found = read(self, number, **options)
        if number == 4:
            edit(path)
        return found

    monkeypatch.setattr(Sequence, "frame", frame)
    result = run(shot, tmp_path / "out")
    monkeypatch.undo()
    assert not result.complete
    assert set(result.shots[0].failed) == {4}
    assert not (tmp_path / "out/s1/denoise.json").exists()
    assert run(shot, tmp_path / "out").made == 1


def test_a_result_that_vanishes_while_the_film_runs_is_made_again(
    shot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, read, left = tmp_path / "out", Sequence.frame, [1]

    def frame(self: Sequence, number: int, **options: Any) -> Any:
        if number == 4 and left:
            (out / f"s1/denoised{left.pop()}.exr").unlink()
        return read(self, number, **options)

    monkeypatch.setattr(Sequence, "frame", frame)
    assert run(shot, out).complete
    assert len(list(out.glob("s1/*.exr"))) == 5


def test_frames_of_several_windows_are_compared_and_shown_in_one(tmp_path: Path) -> None:
    pytest.importorskip("av")
    (tmp_path / "in").mkdir()
    for number in range(4):
        size = {"dataWindow": (np.int32([number, 2]), np.int32([number + 20 + number, 17]))}
        header = {**size, "displayWindow": (np.int32([0, 0]), np.int32([39, 29])), "type": OpenEXR.scanlineimage}
        pixels = np.full((16, 21 + number), 0.5, np.float32)
        OpenEXR.File({**header, "compression": OpenEXR.ZIP_COMPRESSION}, dict.fromkeys("RGB", pixels)).write(
            str(tmp_path / f"in/a_{number}.exr")
        )
    manifest = write_manifest(tmp_path / "film.toml", {"a": tmp_path / "in"}, model="noisy", preview=True)
    assert run_film(Film(read_film(manifest), tmp_path / "out"), Inline()).complete
    assert (tmp_path / "out/a/preview.mp4").is_file()
