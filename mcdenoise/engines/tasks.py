"""Independent tasks, retried when their workers are lost."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass
from typing import Any

from mcdenoise.engines.engine import MOST_LOSSES, Done, Engine, describe_error
from mcdenoise.errors import InputError

_SECONDS_BETWEEN_POLLS = 0.2


@dataclass(frozen=True)
class Task:
    """A call that a worker can repeat: it writes its results to the disk, and keeps those that it finds there.

    Args:
        name: for messages.
        function: of a module that workers can import.
        arguments: of the function.
        progress: a value that changes whenever the task advances, so that one that loses its worker now and then is
            retried for as long as it advances. By default only the number of losses counts.
    """

    name: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...] = ()
    progress: Callable[[], object] = lambda: None


@dataclass
class _Attempt:
    task: Task
    losses: int = 0
    progress: object = None


def run_tasks(
    engine: Engine, tasks: Iterable[Task], on_done: Callable[[Task, Any], None] = lambda task, answer: None
) -> dict[str, str]:
    """Run tasks until each has succeeded or failed; the engine is closed at the end, however that comes.

    A task whose worker is lost is retried, up to five times in a row without progress. A task that raises an error
    has failed, and the others go on.

    Args:
        engine: runs the tasks.
        tasks: in the order in which they are started; no two have one name.
        on_done: called with each task that succeeded, and its answer.

    Returns:
        For each task that failed, by name, the reason.
    """
    queue = deque(_Attempt(task, progress=task.progress()) for task in tasks)
    running: dict[Hashable, _Attempt] = {}
    failed: dict[str, str] = {}

    def end(attempt: _Attempt, done: Done) -> None:
        task, error = attempt.task, done.error
        if done.lost:
            progress = task.progress()
            losses = 1 if progress != attempt.progress else attempt.losses + 1
            if losses < MOST_LOSSES:
                queue.appendleft(_Attempt(task, losses, progress))
                return
            error = InputError(f"{done.lost}, {losses} times in a row")
        if error is None:
            on_done(task, done.answer)
        else:
            failed[task.name] = describe_error(error)

    try:
        while queue or running:
            for _ in range(min(len(queue), engine.free_slots()) if queue else 0):
                attempt = queue.popleft()
                running[engine.submit(attempt.task.function, *attempt.task.arguments)] = attempt
            for handle, done in engine.finished(_SECONDS_BETWEEN_POLLS).items():
                end(running.pop(handle), done)
    finally:
        engine.close()
    return failed
