"""A film checks every shot before any work, and its frames once more at the end."""

import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from commands import refuses, succeeds
from shots import Inline, edit, same, write_manifest, write_shot

from mcdenoise.data import Sequence
from mcdenoise.film import ShotResult, read_film, run_film

SHOT = '[[shot]]\nname = "{}"\ninput = "s1"\nframes = "0-1"\n{}\n'
DIGITS = "1" + 5000 * "0"


@pytest.fixture
def shot(tmp_path: Path) -> Path:
    return write_shot(tmp_path / "s1", 5)


def run(shot: Path, out: Path) -> ShotResult:
    manifest = write_manifest(out.parent / "film.toml", {"s1": shot}, model="accumulated")
    return run_film(read_film(manifest), out, Inline())[0]


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
    shot: Path, tmp_path: Path, setting: str
) -> None:
    manifest = tmp_path / "film.toml"
    wrong = SHOT.format("wrong", setting)
    if "frames" in setting:
        wrong = wrong.replace('frames = "0-1"\n', "")
    manifest.write_text(SHOT.format("right", 'model = "noisy"') + wrong)
    assert len(refuses("film", manifest, "-o", tmp_path / "out")) < 2000
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("inline")
def test_the_model_that_a_limit_picks_is_told_everywhere(shot: Path, tmp_path: Path) -> None:
    manifest = tmp_path / "film.toml"
    manifest.write_text(SHOT.format("any", "budget_ms = 60000"))
    printed = succeeds("film", manifest, "-o", tmp_path / "out")
    about = json.loads((tmp_path / "out/any/denoise.json").read_text())
    assert about["picked"].startswith(f"{about['model']}")
    assert json.loads((tmp_path / "out/film.json").read_text())["shots"][0]["picked"] == about["picked"]
    assert about["picked"] in (tmp_path / "out/film.html").read_text()
    assert about["picked"] in " ".join(printed.split())


@pytest.mark.parametrize("when", ["before it is read", "after it was read", "after it was denoised"])
def test_a_frame_that_changes_while_the_film_runs_is_made_again_by_the_next_run(
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
            new = Path(shutil.copy(left.pop(), tmp_path / "new.exr"))
            edit(new)
            # Of the same size; and a copy may keep the time of its source.
            new.write_bytes(new.read_bytes().ljust(20_000))
            os.utime(new, ns=(status.st_atime_ns, status.st_mtime_ns))
            # At once: another thread may be reading the file for the frame that it writes.
            new.replace(path)

    monkeypatch.setattr(Sequence, "frame", frame)
    result = run(shot, tmp_path / "out")
    monkeypatch.undo()
    assert not left
    assert path.stat().st_size == status.st_size
    assert not result.complete
    assert set(result.failed) == {2, 3, 4}
    assert "changed" in result.failed[2]
    assert not (tmp_path / "out/s1/denoise.json").exists()
    assert run(shot, tmp_path / "out").complete
    assert run(shot, tmp_path / "fresh").complete
    assert same(tmp_path / "out/s1", tmp_path / "fresh/s1")
    assert run(shot, tmp_path / "out").made == 0


def test_a_result_that_vanishes_while_the_film_runs_is_made_again_by_the_next_run(
    shot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, read, left = tmp_path / "out", Sequence.frame, [1]

    def frame(self: Sequence, number: int, **options: Any) -> Any:
        if number == 4 and left:
            (out / f"s1/denoised{left.pop()}.exr").unlink()
        return read(self, number, **options)

    monkeypatch.setattr(Sequence, "frame", frame)
    assert set(run(shot, out).failed) == {1}
    assert run(shot, out).complete
    assert len(list(out.glob("s1/*.exr"))) == 5
