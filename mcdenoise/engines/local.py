"""Tasks run by processes of this machine."""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable, Hashable
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from mcdenoise.engines.engine import Done
from mcdenoise.errors import InputError
from mcdenoise.interruption import deaf_children, prepare_worker, start_resource_tracker

# In this time an interrupted worker removes the file that it is writing.
_SECONDS_TO_END = 0.3


def processors() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class LocalEngine:
    """Worker processes of this machine.

    Each worker is a process pool of its own, because a killed worker breaks its pool.

    Args:
        workers: number of processes, at least 1.
        preload: module that workers have imported when they start.

    Raises:
        InputError: ``workers`` is less than 1.
    """

    def __init__(self, workers: int, preload: str = "torch") -> None:
        if workers < 1:
            raise InputError(f"--workers: expected at least 1, found {workers}")
        # Forks of a process that has imported the module, and does nothing else, start at once.
        forks = sys.platform.startswith("linux")
        self._context = multiprocessing.get_context("forkserver" if forks else "spawn")
        if forks:
            self._context.set_forkserver_preload([preload])
        start_resource_tracker()
        self._before = set(multiprocessing.active_children())
        self._pools = [self._pool() for _ in range(workers)]
        self._running: dict[Future[Any], int] = {}

    def free_slots(self) -> int:
        """See :class:`Engine`."""
        return len(self._pools) - len(self._running)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Hashable:
        """See :class:`Engine`."""
        slot = min(set(range(len(self._pools))) - set(self._running.values()))
        with deaf_children():
            try:
                future = self._pools[slot].submit(function, *arguments)
            except BrokenProcessPool:
                # It was killed while it was idle.
                self._renew(slot)
                future = self._pools[slot].submit(function, *arguments)
        self._running[future] = slot
        return future

    def finished(self, seconds: float) -> dict[Hashable, Done]:
        """See :class:`Engine`."""
        found: dict[Hashable, Done] = {}
        for future in wait(self._running, seconds, FIRST_COMPLETED).done:
            slot = self._running.pop(future)
            error = future.exception()
            if isinstance(error, BrokenProcessPool):
                self._renew(slot)
                found[future] = Done(lost="its process ended without a word, perhaps for lack of memory")
            else:
                found[future] = Done(error=error) if error is not None else Done(future.result())
        return found

    def close(self) -> None:
        """See :class:`Engine`."""
        for pool in self._pools:
            pool.shutdown(wait=False, cancel_futures=True)
        self._pools = []
        children = set(multiprocessing.active_children()) - self._before
        for child in children if self._running else ():
            child.terminate()
        for child in children if self._running else ():
            child.join(_SECONDS_TO_END / len(children))
            child.kill()
        self._running = {}

    def _pool(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(1, self._context, prepare_worker)

    def _renew(self, slot: int) -> None:
        self._pools[slot].shutdown(wait=False)
        self._pools[slot] = self._pool()
