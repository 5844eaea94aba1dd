"""Tasks of lost workers are retried, tasks that raise errors fail alone."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Hashable
from importlib.metadata import version
from pathlib import Path

import pytest
from calls import die_at_first, fail, fail_strangely, mark

from mcdenoise.engines import MOST_LOSSES, Done, LocalEngine, Task, cluster, run_tasks
from mcdenoise.errors import InputError


@pytest.fixture(autouse=True)
def _importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers find the functions of these tests."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=":")


@pytest.mark.skipif(sys.platform == "win32", reason="processes kill themselves by a signal")
def test_lost_tasks_are_retried_and_failed_ones_are_named(tmp_path: Path) -> None:
    answers: dict[str, str] = {}
    losses = {"lost": 1, "advancing": MOST_LOSSES + 1, "hopeless": MOST_LOSSES}

    def task(name: str) -> Task:
        # One advances with each attempt, so that it may lose more workers than others.
        advances = (lambda: len(list(tmp_path.glob("advancing.try*")))) if name == "advancing" else lambda: None
        return Task(name, die_at_first, (tmp_path, name, losses[name]), advances)

    tasks = [Task("quiet", mark, (tmp_path, "quiet")), Task("failing", fail, ("two\nlines",)), *map(task, losses)]
    failed = run_tasks(LocalEngine(2), tasks, lambda task, answer: answers.update({task.name: answer}))
    assert failed == {
        "failing": "RuntimeError: two lines",
        "hopeless": f"its process ended without a word, perhaps for lack of memory, {MOST_LOSSES} times in a row",
    }
    assert answers == {name: name for name in ("quiet", "lost", "advancing")}
    # Nobody tries more often than that.
    assert not (tmp_path / "hopeless").exists()


def test_no_workers_are_refused() -> None:
    with pytest.raises(InputError, match=r"--workers: .*0"):
        LocalEngine(0)


def test_a_driver_of_another_version_is_refused() -> None:
    assert cluster._call(version("mcdenoise"), len, "four") == 4
    with pytest.raises(InputError, match=r"expected version 9\.9, as the driver has, found"):
        cluster._call("9.9", len, "four")


def kill_children() -> int:
    """Kill every process that this one has started, whatever it is for, and return how many there were."""
    found = [int(each) for path in Path("/proc/self/task").glob("*/children") for each in path.read_text().split()]
    for process in found:
        os.kill(process, signal.SIGKILL)
    return len(found)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are found in /proc")
@pytest.mark.filterwarnings("ignore:resource_tracker")
def test_every_process_may_be_killed_at_any_time(tmp_path: Path) -> None:
    killed = []

    class Attacked(LocalEngine):
        """While workers start, after they have started, and while they wait for a task."""

        def finished(self, seconds: float) -> dict[Hashable, Done]:
            if len(killed) < 3:
                found = super().finished(0.0 if not killed else 10.0)
                killed.append(kill_children())
                return found
            return super().finished(seconds)

    names = {f"{number}" for number in range(8)}
    tasks = [Task(name, mark, (tmp_path, name)) for name in sorted(names)]
    assert run_tasks(Attacked(2), tasks) == {}
    assert min(killed) >= 1
    assert {path.name for path in tmp_path.iterdir()} == names


def test_errors_that_cannot_be_sent_are_told() -> None:
    assert run_tasks(LocalEngine(1), [Task("own", fail_strangely), Task("exits", sys.exit, (0,))]) == {
        "own": "Strange: 7 and 8",
        "exits": "SystemExit: 0",
    }
