"""Signals in every phase of a film, and of rendering by several processes: one line, nothing half-written."""

import json
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from shots import pixels, write_manifest, write_shot
from test_interruption import OBEYING, end, started

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="signals are those of Linux")
FRAMES = 60
# The limit is that of a machine that others use, too.
SECONDS = 240.0
PHASES: dict[str, Callable[[Path], bool]] = {
    "looking": lambda out: (out / ".film/.lock").exists(),
    "first frame": lambda out: bool(list(out.glob(".film/s/*.json"))),
    "middle": lambda out: len(list(out.glob("s/*.exr"))) >= FRAMES // 3,
    "closing": lambda out: len(list(out.glob("s/*.exr"))) == FRAMES,
}


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
    shot = write_shot(tmp_path / "renders/s", FRAMES)
    manifest, out = write_manifest(tmp_path / "film.toml", {"s": shot}, model="accumulated"), tmp_path / "out"
    process = started(OBEYING, "film", manifest, "-o", out, "--workers", 2, folder=tmp_path)
    process.stdout.readline()
    until = time.monotonic() + SECONDS
    while not PHASES[phase](out):
        assert process.poll() is None
        assert time.monotonic() < until
        time.sleep(0.002)
    end(process, number, "film", lines=2)
    pixels(out / "s")
    if phase == "middle":
        assert not json.loads((out / "film.json").read_text())["complete"]
    assert not [path for path in out.rglob("*") if path.name.startswith(".mcdenoise-")]
