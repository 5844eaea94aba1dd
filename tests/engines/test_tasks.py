"""Tasks of lost workers are retried, tasks that raise errors fail alone."""

from __future__ import annotations

import sys
from importlib.metadata import version
from pathlib import Path

import pytest
from calls import die_at_first, fail, mark

from mcdenoise.engines import MOST_LOSSES, LocalEngine, Task, cluster, run_tasks
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
    with pytest.raises(InputError, match="--workers: expected at least 1, found 0"):
        LocalEngine(0)


def test_a_driver_of_another_version_is_refused() -> None:
    assert cluster._call(version("mcdenoise"), len, "four") == 4
    with pytest.raises(InputError, match=r"expected version 9\.9, as the driver has, found"):
        cluster._call("9.9", len, "four")
