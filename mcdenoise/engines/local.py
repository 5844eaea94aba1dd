"""Tasks run by processes of this machine."""

from __future__ import annotations

import itertools
import multiprocessing
import os
from collections.abc import Callable, Hashable
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from typing import Any

from mcdenoise.engines.engine import Done, describe_error
from mcdenoise.errors import InputError
from mcdenoise.interruption import deaf_children, prepare_worker, start_resource_tracker

# In this time an interrupted worker removes the file that it is writing.
_SECONDS_TO_END = 0.3


def processors() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class LocalEngine:
    """Worker processes of this machine.

    Each has a pipe of its own, and shares no lock, server or queue with others: one that is killed is lost alone.

    Args:
        workers: number of processes, at least 1.

    Raises:
        InputError: ``workers`` is less than 1.
    """

    def __init__(self, workers: int) -> None:
        if workers < 1:
            raise InputError(f"--workers: expected at least 1, found {workers}")
        self._workers = workers
        self._idle: list[_Worker] = []
        self._running: dict[Hashable, _Worker] = {}
        self._handles = itertools.count()
        start_resource_tracker()

    def free_slots(self) -> int:
        """See :class:`Engine`."""
        return self._workers - len(self._running)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Hashable:
        """See :class:`Engine`."""
        handle = next(self._handles)
        with deaf_children():
            worker = self._running[handle] = self._idle.pop() if self._idle else _Worker()
        # One that was killed while it was idle is found when the task is waited for.
        with suppress(ConnectionError):
            worker.pipe.send((function, arguments))
        return handle

    def finished(self, seconds: float) -> dict[Hashable, Done]:
        """See :class:`Engine`."""
        found: dict[Hashable, Done] = {}
        ready = wait([worker.pipe for worker in self._running.values()], seconds)
        for handle in [handle for handle, worker in self._running.items() if worker.pipe in ready]:
            worker = self._running.pop(handle)
            try:
                found[handle] = worker.pipe.recv()
                self._idle.append(worker)
            except (EOFError, OSError):
                worker.end()
                found[handle] = Done(lost="its process ended without a word, perhaps for lack of memory")
        return found

    def close(self) -> None:
        """See :class:`Engine`."""
        running = list(self._running.values())
        for worker in self._idle:
            worker.pipe.close()
        for worker in running:
            worker.process.terminate()
        for worker in running:
            worker.process.join(_SECONDS_TO_END / len(running))
            worker.end()
        self._idle, self._running = [], {}


class _Worker:
    """A process that runs the tasks which it gets through a pipe, until the pipe is closed."""

    def __init__(self) -> None:
        # A fork of a process with threads may hold their locks for ever.
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self.process = context.Process(target=_work, args=(other,))
        self.process.start()
        # Only the worker has that end now, so that its death closes the pipe.
        other.close()

    def end(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()


def _work(pipe: Connection) -> None:
    """In a worker: run tasks."""
    prepare_worker()
    while True:
        try:
            function, arguments = pipe.recv()
        except EOFError:
            return
        try:
            done = Done(function(*arguments))
        except BaseException as error:  # a user's model may even exit
            # Not every error can be sent, or be made again by the driver.
            done = Done(error=InputError(describe_error(error)))
        pipe.send(done)
