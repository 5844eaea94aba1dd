"""Processes that are killed while they make a film, by the system or by a user: nothing is lost or partial."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from shots import pixels, same, write_manifest, write_shot

from mcdenoise.cli import main
from mcdenoise.engines import LocalEngine
from mcdenoise.film import Film, read_film, run_film
from mcdenoise.film.record import read_records

# The limit is that of a machine that others use, too.
SECONDS = 240.0


class Killer(threading.Thread):
    """Kills a process that makes a piece as soon as it has finished some frames, however fast the machine is.

    Args:
        out: of the film, whose journals say which processes there are.
        most: frames that one finishes before it is killed, at most; none, at times, but never of two in a row, with
            whom nothing would ever be finished.
        seed: of the draws.
    """

    def __init__(self, out: Path, most: int, seed: int) -> None:
        super().__init__(daemon=True)
        self.out, self.most, self.random = out, most, random.Random(seed)
        self.killed = 0
        self.over = threading.Event()

    def run(self) -> None:
        wanted = 1
        while not self.over.wait(0.01):
            found = {process: frames for process, frames in self.processes().items() if is_worker(process)}
            ready = sorted(process for process, frames in found.items() if frames >= wanted)
            if ready:
                os.kill(self.random.choice(ready), signal.SIGKILL)
                self.killed += 1
                wanted = self.random.randint(0 if wanted else 1, self.most)

    def processes(self) -> dict[int, int]:
        """Return how many frames of its current piece each process has finished."""
        found: dict[int, int] = {}
        for path in sorted(self.out.glob(".film/*/*.jsonl"), key=lambda path: path.stat().st_mtime_ns):
            process = 0
            for line in path.read_text().splitlines():
                if line.startswith('{"process"'):
                    process = int(json.loads(line)["process"])
                    found[process] = 0
                elif line.startswith('{"number"'):
                    found[process] += 1
        return found


def is_worker(process: int) -> bool:
    """Whether it is alive, and one of ours; numbers are given again."""
    try:
        command = Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return False
    return (b"multiprocessing.spawn" in command or b"ray::" in command) and process != os.getpid()


def make_shots(folder: Path, count: int, frames: int) -> dict[str, Path]:
    return {f"s{i:02d}": write_shot(folder / f"in{i:02d}", frames, seed=i) for i in range(count)}


def check_killed(tmp_path: Path, shots: int, frames: int, most: int, least: int, model: str) -> None:
    """A film whose processes are killed is, bit by bit, one that is left alone.

    Shots are no longer than what a method remembers twice over, so that each begins again with its first frame.
    """
    manifest = write_manifest(tmp_path / "film.toml", make_shots(tmp_path, shots, frames), model=model)
    assert run_film(Film(read_film(manifest), tmp_path / "quiet", threads=1), LocalEngine(1)).complete
    killer = Killer(tmp_path / "out", most, seed=1)
    killer.start()
    try:
        result = run_film(Film(read_film(manifest), tmp_path / "out", threads=1), LocalEngine(2))
    finally:
        killer.over.set()
        killer.join()
    assert killer.killed >= least
    assert result.complete, [each.failures() for each in result.shots]
    for name in (f"s{i:02d}" for i in range(shots)):
        assert same(tmp_path / "out" / name, tmp_path / "quiet" / name)
        assert len(pixels(tmp_path / "out" / name)) == frames
        assert (tmp_path / "out" / name / "denoise.json").is_file()


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are found in /proc")
def test_killed_workers_lose_nothing(tmp_path: Path) -> None:
    check_killed(tmp_path, shots=3, frames=30, most=12, least=4, model="accumulated")


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are found in /proc")
def test_twenty_shots_with_a_worker_killed_every_few_seconds(tmp_path: Path) -> None:
    check_killed(tmp_path, shots=20, frames=40, most=60, least=3, model="cascaded_v2_micro")


def start(manifest: Path, out: Path, *options: str) -> subprocess.Popen[str]:
    """The command, in a process of its own."""
    command = [sys.executable, "-m", "mcdenoise", "film", str(manifest), "-o", str(out), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wait_for_frames(out: Path, count: int, process: subprocess.Popen[str]) -> None:
    until = time.monotonic() + SECONDS
    while len(list(out.glob("s*/*.exr"))) < count:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < until
        time.sleep(0.02)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are found in /proc")
@pytest.mark.slow
def test_a_killed_driver_takes_its_workers_along_and_the_next_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shots = make_shots(tmp_path, 1, 90)
    manifest, out = write_manifest(tmp_path / "film.toml", shots, model="accumulated"), tmp_path / "out"
    first = start(manifest, out)
    wait_for_frames(out, 3, first)
    # A second one says so, and stops.
    with pytest.raises(SystemExit) as stop:
        main(["film", str(manifest), "-o", str(out)])
    assert first.poll() is None
    message = capsys.readouterr().err
    assert stop.value.code == 2
    assert message.startswith(
        f"mcdenoise film: {out}/.film: expected a folder that no other film writes to, found process"
    )
    assert message.count("\n") == 1
    first.kill()
    first.communicate()
    workers = Killer(out, 1, 0).processes()
    until = time.monotonic() + SECONDS
    while any(is_worker(process) for process in workers):
        assert time.monotonic() < until
        time.sleep(0.05)
    finished = {number for each in shots for number in read_records(out / ".film" / each)}
    assert 3 <= len(finished) < 90
    # A file with its final name is whole.
    assert len(pixels(out / "s00")) >= 3
    kept = {number: record.at for number, record in read_records(out / ".film/s00").items()}
    assert run_film(Film(read_film(manifest), out, threads=1), LocalEngine(1)).complete
    after = read_records(out / ".film/s00")
    assert {number: after[number].at for number in kept} == kept
    assert len(pixels(out / "s00")) == 90
