"""Tasks of lost workers are retried, tasks that raise errors fail alone."""

import os
import re
import signal
import sys
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
from calls import die_at_first, fail, fail_strangely, mark
from refusals import refused

from mcdenoise import engines
from mcdenoise.engines import MOST_LOSSES, LocalEngine, RayEngine, Task, parse_workers, run_tasks


@pytest.fixture(autouse=True)
def _importable(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers find the functions of these tests."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=":")


class Run:
    def __init__(self) -> None:
        self.answers: dict[str, object] = {}
        self.failed: dict[str, str] = {}
        self.tasks: deque[Task] = deque()

    def add(self, name: str, function: Callable[..., Any], *arguments: object) -> None:
        self.tasks.append(Task(function, arguments, partial(self._end, name)))

    def _end(self, name: str, answer: object, reason: str | None) -> None:
        if reason is None:
            self.answers[name] = answer
        else:
            self.failed[name] = reason


@pytest.mark.skipif(sys.platform == "win32", reason="processes kill themselves by a signal")
def test_lost_tasks_are_retried_and_failed_ones_are_named(tmp_path: Path) -> None:
    run = Run()
    # A task may add another at its end.
    run.tasks.append(Task(mark, (tmp_path, "one"), lambda answer, reason: run.add("next", mark, tmp_path, answer)))
    run.add("failing", fail, "two\nlines")
    run.add("strange", fail_strangely)
    run.add("exits", sys.exit, 0)
    run.add("lost", die_at_first, tmp_path, "lost", 1)
    run.add("hopeless", die_at_first, tmp_path, "hopeless", MOST_LOSSES)
    run_tasks(LocalEngine(2), run.tasks)
    assert f"{MOST_LOSSES} times" in run.failed.pop("hopeless")
    assert run.failed == {
        "failing": "RuntimeError: two lines",
        "strange": "Strange: 7 and 8",
        "exits": "it ends the program (SystemExit: 0)",
    }
    assert run.answers == {"next": "one", "lost": "lost"}
    # Nobody tries more often than that.
    assert not (tmp_path / "hopeless").exists()


def test_workers_are_a_number_or_a_cluster(monkeypatch: pytest.MonkeyPatch) -> None:
    assert (parse_workers("2"), parse_workers("auto")) == (2, None)
    assert re.search(r"--workers.*0", refused(parse_workers, "0"))
    monkeypatch.setitem(sys.modules, "ray", None)
    assert re.search(r"auto.*mcdenoise\[ray\]", refused(RayEngine, "auto"))


def test_a_driver_of_another_version_is_refused() -> None:
    assert engines._call(version("mcdenoise"), len, "four") == (4, None)
    assert "9.9" in str(engines._call("9.9", len, "four"))


def kill_children() -> int:
    found: list[int] = []
    for path in Path("/proc/self/task").glob("*/children"):
        # A thread may end while it is read, and a process before it is killed.
        with suppress(FileNotFoundError, ProcessLookupError):
            found += map(int, path.read_text().split())
    for process in found:
        with suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)
    return len(found)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are found in /proc")
@pytest.mark.filterwarnings("ignore:resource_tracker")
def test_every_process_may_be_killed_at_any_time(tmp_path: Path) -> None:
    killed: list[int] = []
    run, names = Run(), [f"{number}" for number in range(6)]
    for name in names:
        run.add(name, mark, tmp_path, name)

    def attack() -> None:
        """While workers start, after they have started, and while they wait for a task."""
        if len(killed) < 3 and (not killed or len(run.answers) >= len(killed)):
            killed.append(kill_children())

    run_tasks(LocalEngine(2), run.tasks, attack)
    assert run.failed == {}
    assert min(killed) >= 1
    assert sorted(path.name for path in tmp_path.iterdir()) == names
