"""A film gives what `mcdenoise denoise` gives, makes nothing twice, and loses nothing but what is damaged."""

import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import run as command
from commands import succeeds
from refusals import refused
from shots import Inline, edit, pixels, same, write_manifest, write_shot

from mcdenoise import Denoiser
from mcdenoise.data.files import held
from mcdenoise.data.png import read_png
from mcdenoise.data.radiance import write_radiance
from mcdenoise.film import ShotResult, read_film, run_film
from mcdenoise.metrics import display_codes
from mcdenoise.shot import ShotSettings

MODEL = "accumulated"


@pytest.fixture
def shots(tmp_path: Path) -> dict[str, Path]:
    return {f"s{i}": write_shot(tmp_path / "renders" / f"s{i}", 4 + i, seed=i) for i in range(2)}


def run(shots: dict[str, Path], out: Path, engine: Inline | None = None, **every: Any) -> list[ShotResult]:
    manifest = write_manifest(out.parent / "film.toml", shots, **{"model": MODEL, **every})
    return run_film(read_film(manifest), out, engine or Inline())


def complete(results: list[ShotResult]) -> bool:
    return all(each.complete for each in results)


def made(results: list[ShotResult]) -> int:
    return sum(each.made for each in results)


def test_it_gives_what_denoise_gives(shots: dict[str, Path], tmp_path: Path) -> None:
    results = run(shots, tmp_path / "out")
    assert complete(results)
    assert made(results) == 9
    for name, folder in shots.items():
        succeeds("denoise", folder, "-o", tmp_path / name, "--model", MODEL)
        assert same(tmp_path / "out" / name, tmp_path / name)
        film, alone = (json.loads((tmp_path / each / name / "denoise.json").read_text()) for each in ("out", ""))
        assert film.keys() == alone.keys()
        for key in ("model", "picked", "sequence", "read", "warnings", "plan", "tiles", "precision"):
            assert film[key] == alone[key], key
        for number, about in alone["frames"].items():
            times = dict.fromkeys(("milliseconds", "beside"), 0)
            assert film["frames"][number] | times == about | times
    assert {path.name for path in (tmp_path / "out").iterdir()} == {".film", "film.json", "film_pictures", *shots}


@pytest.mark.parametrize(
    ("ending", "options"),
    [(".exr", {"output_layer": "Clean"}), (".tif", {"input_linear": True})],
)
def test_its_preview_shows_what_was_denoised(ending: str, options: dict[str, Any], tmp_path: Path) -> None:
    noisy = np.random.default_rng(0).random((20, 32, 3), dtype=np.float32)
    (tmp_path / "in").mkdir()
    write_radiance(tmp_path / "in" / f"shot{ending}", noisy)
    every = {"model": "joint_bilateral", "preview": True, "preview_exposure": 0.0, **options}
    run({"s": tmp_path / "in"}, tmp_path / "out", **every)
    opened = ShotSettings(**options).open([tmp_path / "in"])
    expected = display_codes(Denoiser("joint_bilateral")(opened.frame(0))[0]).permute(1, 2, 0).numpy()
    found = read_png(tmp_path / "out/s/preview/shot.png")
    np.testing.assert_allclose(found.astype(int), expected, atol=1)


def test_finished_frames_are_not_made_again(shots: dict[str, Path], tmp_path: Path) -> None:
    run(shots, tmp_path / "out")
    times = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").glob("s*/*.exr")}
    engine = Inline()
    results = run(shots, tmp_path / "out", engine)
    assert (complete(results), made(results)) == (True, 0)
    assert "make" not in engine.tasks
    assert times == {path: path.stat().st_mtime_ns for path in times}
    # A film may be moved.
    (tmp_path / "out").rename(tmp_path / "moved")
    assert made(run(shots, tmp_path / "moved")) == 0


@pytest.mark.parametrize(
    ("change", "again"),
    [
        # A frame of another file, and those that remember it.
        (lambda shots, out: edit(shots["s1"] / "inputs/color3.exr"), [3, 4]),
        (lambda shots, out: edit(shots["s1"] / "inputs/albedo0.exr"), [0, 1, 2, 3, 4]),
        (lambda shots, out: (out / "s1/denoised2.exr").unlink(), [2]),
        (lambda shots, out: edit(out / "s1/denoised2.exr"), [2]),
        # The record of a frame is damaged.
        (lambda shots, out: truncate(out / ".film/s1/3.json"), [3]),
        # References change no result.
        (lambda shots, out: shutil.copy(shots["s1"] / "inputs/color0.exr", shots["s1"] / "inputs/reference0.exr"), []),
    ],
    ids=["color", "albedo", "gone", "edited", "record", "reference"],
)
def test_changed_frames_are_made_again(
    shots: dict[str, Path], tmp_path: Path, change: Callable[[dict[str, Path], Path], object], again: list[int]
) -> None:
    run(shots, tmp_path / "out")
    before = written(tmp_path / "out")
    change(shots, tmp_path / "out")
    (result,) = run({"s1": shots["s1"]}, tmp_path / "out")
    after = written(tmp_path / "out")
    assert result.complete
    assert [number for number in after if after[number] != before[number]] == again
    assert result.made == len(again)
    run({"s1": shots["s1"]}, tmp_path / "fresh")
    assert same(tmp_path / "out/s1", tmp_path / "fresh/s1")


def written(out: Path) -> dict[int, int]:
    return {number: (out / f"s1/denoised{number}.exr").stat().st_mtime_ns for number in range(5)}


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-40])


def test_other_settings_make_all_anew_and_silent_ones_nothing(shots: dict[str, Path], tmp_path: Path) -> None:
    run(shots, tmp_path / "out")
    assert made(run(shots, tmp_path / "out", threads=1)) == 0
    assert made(run(shots, tmp_path / "out", alpha_min=0.3)) == 9
    assert made(run(shots, tmp_path / "out", model="noisy")) == 9


def test_lost_tasks_are_done_again_and_again_but_not_for_ever(shots: dict[str, Path], tmp_path: Path) -> None:
    assert complete(run(shots, tmp_path / "quiet"))
    engine = Inline(lambda task, count: count % 3 == 0)
    assert complete(run(shots, tmp_path / "out", engine))
    assert all(same(tmp_path / "out" / name, tmp_path / "quiet" / name) for name in shots)
    results = run(shots, tmp_path / "never", Inline(lambda task, count: task == "make"))
    assert not complete(results)
    ((frames, why),) = results[0].failures()
    assert frames == "0 to 3 (4)"
    assert "lost, 5 times" in why
    assert not list((tmp_path / "never").glob("s*/*.exr"))


@pytest.mark.parametrize(
    "damage",
    [lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]), lambda path: path.write_bytes(b"")],
    ids=["cut off", "empty"],
)
def test_a_damaged_frame_fails_alone(shots: dict[str, Path], tmp_path: Path, damage: Callable[[Path], object]) -> None:
    path = shots["s1"] / "inputs/color2.exr"
    whole = path.read_bytes()
    damage(path)
    results = run(shots, tmp_path / "out")
    assert [each.complete for each in results] == [True, False]
    assert set(results[1].failed) == {2}
    assert "color2.exr" in results[1].failed[2]
    assert sorted(pixels(tmp_path / "out/s1")) == [f"denoised{n}.exr" for n in (0, 1, 3, 4)]
    assert not (tmp_path / "out/s1/denoise.json").exists()
    # It is rendered again; what remembers it is made again too.
    path.write_bytes(whole)
    assert complete(run(shots, tmp_path / "out"))
    run(shots, tmp_path / "fresh")
    assert same(tmp_path / "out/s1", tmp_path / "fresh/s1")
    assert (tmp_path / "out/s1/denoise.json").exists()


@pytest.mark.usefixtures("inline")
def test_the_table_of_what_failed_and_status_1(shots: dict[str, Path], tmp_path: Path) -> None:
    (shots["s1"] / "inputs/color2.exr").write_bytes(b"")
    manifest = write_manifest(tmp_path / "film.toml", {**shots, "gone": tmp_path / "nowhere"}, model=MODEL)
    status, printed, _ = command("film", manifest, "-o", tmp_path / "out")
    assert status == 1
    assert re.search(r"gone +│ all +│ .*nowhere: expected a folder", printed)
    assert re.search(r"s1 +│ 2 +│ .*color2.exr", printed)
    assert "  s0: 4 frames, 4 made" in printed
    assert "1 of 3 shots complete, 8 frames made" in printed
    assert not json.loads((tmp_path / "out/film.json").read_text())["complete"]
    assert "failed" in (tmp_path / "out/film.html").read_text()


def test_a_full_disk_ends_a_piece_and_no_more(
    shots: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replace, count = os.replace, []

    def full(source: Any, target: Any) -> None:
        if "/s0/" in str(target):
            count.append(target)
            raise OSError(28, "No space left on device")
        replace(source, target)

    monkeypatch.setattr(os, "replace", full)
    results = run(shots, tmp_path / "out")
    assert [each.complete for each in results] == [False, True]
    ((frames, why),) = results[0].failures()
    assert frames == "0 to 3 (4)"
    assert "No space left on device" in why
    # One was tried, and not every frame.
    assert len(count) == 1
    assert [path.name for path in (tmp_path / "out/s0").iterdir()] == []
    monkeypatch.undo()
    assert complete(run(shots, tmp_path / "out"))


def test_a_model_that_fails_is_no_fault_of_the_film(shots: dict[str, Path], tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(
        "def make():\n    def own(color):\n        raise ArithmeticError('no way')\n    return own\n"
    )
    manifest = write_manifest(tmp_path / "film.toml", shots)
    settings = ShotSettings(f"{tmp_path}/mine.py:make")
    results = run_film(read_film(manifest, settings), tmp_path / "out", Inline())
    assert results[0].failures() == [("0 to 3 (4)", "ArithmeticError: no way")]


def test_two_films_in_one_folder(shots: dict[str, Path], tmp_path: Path) -> None:
    (tmp_path / "out/.film").mkdir(parents=True)
    with held(tmp_path / "out/.film", "film"):
        assert "no other film writes to, found process" in refused(run, shots, tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == [".film"]
