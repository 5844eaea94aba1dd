"""Processes that are killed while they make a film, by the system or by a user: nothing is lost or partial."""

from __future__ import annotations

import random
import subprocess
import sys
import time
from collections.abc import Hashable
from pathlib import Path

import pytest
from shots import pixels, same, write_manifest, write_shot

from mcdenoise.cli import main
from mcdenoise.engines import Done, LocalEngine
from mcdenoise.film import Film, read_film, run_film
from mcdenoise.film.record import read_records

# The limit is that of a machine that others use, too.
SECONDS = 240.0


class Attacked(LocalEngine):
    """Kills a worker whenever some frames more are finished, however fast the machine is."""

    def __init__(self, workers: int, out: Path, most: int) -> None:
        super().__init__(workers)
        self.out, self.most, self.random = out, most, random.Random(1)
        self.killed, self.wanted = 0, 1

    def finished(self, seconds: float) -> dict[Hashable, Done]:
        if self._running and len(list(self.out.glob("s*/*.exr"))) >= self.wanted:
            self.random.choice(list(self._running.values())).process.kill()
            self.killed += 1
            self.wanted += self.random.randint(1, self.most)
        return super().finished(0.01)


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.skipif(sys.platform == "win32", reason="processes are killed by a signal")
@pytest.mark.parametrize(("model", "shots", "most"), [("accumulated", 2, 8), ("cascaded_v2_micro", 3, 20)])
def test_killed_workers_lose_nothing(tmp_path: Path, model: str, shots: int, most: int) -> None:
    """A film whose processes are killed is, bit by bit, one that is left alone.

    Shots are no longer than what a method remembers twice over, so that each begins again with its first frame.
    """
    names = {f"s{i}": write_shot(tmp_path / f"in{i}", 24, seed=i) for i in range(shots)}
    manifest = write_manifest(tmp_path / "film.toml", names, model=model)
    assert run_film(Film(read_film(manifest), tmp_path / "quiet", threads=1), LocalEngine(1)).complete
    engine = Attacked(2, tmp_path / "out", most)
    result = run_film(Film(read_film(manifest), tmp_path / "out", threads=1), engine)
    assert engine.killed >= 2
    assert result.complete, [each.failures() for each in result.shots]
    for name in names:
        assert same(tmp_path / "out" / name, tmp_path / "quiet" / name)
        assert (tmp_path / "out" / name / "denoise.json").is_file()


def workers_of(process: int) -> list[int]:
    """The processes that a process has started."""
    return [int(each) for path in Path(f"/proc/{process}/task").glob("*/children") for each in path.read_text().split()]


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are found in /proc")
def test_a_killed_driver_takes_its_workers_along_and_the_next_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shot = write_shot(tmp_path / "in", 60)
    manifest, out = write_manifest(tmp_path / "film.toml", {"s": shot}, model="accumulated"), tmp_path / "out"
    command = [sys.executable, "-m", "mcdenoise", "film", str(manifest), "-o", str(out)]
    first = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    until = time.monotonic() + SECONDS
    while len(list(out.glob("s/*.exr"))) < 3:
        assert first.poll() is None, first.communicate()
        assert time.monotonic() < until
        time.sleep(0.02)
    # A second one says so, and stops.
    with pytest.raises(SystemExit) as stop:
        main(["film", str(manifest), "-o", str(out)])
    assert stop.value.code == 2
    assert capsys.readouterr().err.startswith(f"mcdenoise film: {out}/.film: ")
    workers = workers_of(first.pid)
    assert workers
    first.kill()
    first.communicate()
    while any(Path(f"/proc/{worker}").exists() for worker in workers):
        assert time.monotonic() < until
        time.sleep(0.05)
    # A file with its final name is whole.
    assert 3 <= len(pixels(out / "s")) <= 60
    kept = {number: record.at for number, record in read_records(out / ".film/s").items()}
    assert 3 <= len(kept) < 60
    assert run_film(Film(read_film(manifest), out, threads=1), LocalEngine(1)).complete
    after = read_records(out / ".film/s")
    assert {number: after[number].at for number in kept} == kept
    assert len(pixels(out / "s")) == 60
