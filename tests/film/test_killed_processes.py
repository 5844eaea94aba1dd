"""Processes that are killed while they make a film, by the system or by a user: nothing is lost or partial."""

import subprocess
import sys
import time
from pathlib import Path

import pytest
from commands import refuses
from shots import pixels, write_manifest, write_shot

from mcdenoise.engines import LocalEngine
from mcdenoise.film import read_film, run_film

# The limit is that of a machine that others use, too.
SECONDS = 240.0


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are found in /proc")
def test_a_killed_driver_takes_its_workers_along_and_the_next_goes_on(tmp_path: Path) -> None:
    shot = write_shot(tmp_path / "in", 60)
    manifest = write_manifest(tmp_path / "film.toml", {"s": shot}, model="accumulated", threads=1)
    out = tmp_path / "out"
    command = [sys.executable, "-m", "mcdenoise", "film", str(manifest), "-o", str(out)]
    first = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + SECONDS
    while len(list(out.glob("s/*.exr"))) < 3:
        assert first.poll() is None, first.communicate()
        assert time.monotonic() < until
        time.sleep(0.02)
    assert refuses("film", manifest, "-o", out).startswith(f"mcdenoise film: {out}/.film: ")
    children = Path(f"/proc/{first.pid}/task").glob("*/children")
    workers = [int(each) for path in children for each in path.read_text().split()]
    assert workers
    first.kill()
    first.communicate()
    while any(Path(f"/proc/{worker}").exists() for worker in workers):
        assert time.monotonic() < until
        time.sleep(0.05)
    assert 3 <= len(pixels(out / "s")) <= 60
    kept = {path: path.stat().st_mtime_ns for path in (out / ".film/s").glob("*.json")}
    assert 3 <= len(kept) < 60
    assert all(each.complete for each in run_film(read_film(manifest), out, LocalEngine(1)))
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert len(pixels(out / "s")) == 60
