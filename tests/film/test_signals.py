"""Signals in every phase of a film, and of rendering by several processes: one line, nothing half-written."""

from __future__ import annotations

import json
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from shots import pixels, write_manifest, write_shot
from test_interruption import OBEYING, RENDER, WORDS, end, started

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="signals are those of Linux")
FRAMES = 60
# The limit is that of a machine that others use, too.
SECONDS = 240.0
PHASES: dict[str, Callable[[Path], bool]] = {
    "looking": lambda out: (out / ".film/.lock").exists(),
    "first frame": lambda out: bool(list(out.glob(".film/s/*.jsonl"))),
    "middle": lambda out: len(list(out.glob("s/*.exr"))) >= FRAMES // 3,
    "closing": lambda out: len(list(out.glob("s/*.exr"))) == FRAMES,
}


def interrupt(tmp_path: Path, phase: str, number: signal.Signals) -> None:
    tmp_path.mkdir(exist_ok=True)
    shot = write_shot(tmp_path / "renders/s", FRAMES)
    manifest, out = write_manifest(tmp_path / "film.toml", {"s": shot}, model="accumulated"), tmp_path / "out"
    process = started(OBEYING, "film", manifest, "-o", out, "--workers", 2, folder=tmp_path)
    assert process.stdout is not None
    process.stdout.readline()
    until = time.monotonic() + SECONDS
    while not PHASES[phase](out):
        assert process.poll() is None
        assert time.monotonic() < until
        time.sleep(0.002)
    end(process, number, "film", lines=2)
    # A file with its final name is whole, and no other file is left.
    pixels(out / "s")
    if phase == "middle":
        assert not json.loads((out / "film.json").read_text())["complete"]
    assert not [path for path in out.rglob("*") if path.name.startswith(".mcdenoise-")]


@pytest.mark.parametrize(
    ("phase", "number"),
    [
        pytest.param("looking", signal.SIGHUP, marks=pytest.mark.slow),
        ("first frame", signal.SIGINT),
        pytest.param("middle", signal.SIGTERM, marks=pytest.mark.slow),
        pytest.param("closing", signal.SIGHUP, marks=pytest.mark.slow),
    ],
    ids=lambda each: getattr(each, "name", each),
)
def test_a_signal_ends_a_film_with_one_line(tmp_path: Path, phase: str, number: signal.Signals) -> None:
    interrupt(tmp_path, phase, number)


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("number", WORDS, ids=lambda each: each.name)
@pytest.mark.parametrize("seconds", [0.0, 3.0])
def test_any_signal_ends_generate_with_workers(tmp_path: Path, number: signal.Signals, seconds: float) -> None:
    pytest.importorskip("mitsuba", reason="rendering needs Mitsuba: pip install 'mcdenoise[render]'")
    options = ["--assets", "none", "--seeds", "0-9", "--frames", "4", "--workers", "2", *RENDER]
    process = started(OBEYING, "generate", "-o", tmp_path / "out", *options, folder=tmp_path)
    assert process.stdout is not None
    process.stdout.readline()
    time.sleep(seconds)
    end(process, number, "generate", lines=10)
    assert not [path for path in tmp_path.rglob("*") if path.name.startswith(".mcdenoise-")]
