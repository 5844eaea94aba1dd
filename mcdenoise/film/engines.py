"""Who does the tasks of a film: processes of this machine, or those of a Ray cluster."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Hashable
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from types import FrameType
from typing import Any, Protocol

from mcdenoise.errors import InputError
from mcdenoise.interruption import deaf_children, remove_unfinished

# In which an interrupted process may tidy up what it is just writing.
_SECONDS_TO_END = 0.3
_MODULE = "mcdenoise.film.work"


@dataclass(frozen=True)
class Done:
    """How a task has ended.

    Args:
        answer: what the function returned.
        error: what it raised.
        lost: why nobody knows: the process that did it is no more.
    """

    answer: Any = None
    error: BaseException | None = None
    lost: str = ""


class Engine(Protocol):
    """Does tasks in other processes, and says how they ended."""

    def room(self) -> int:
        """How many tasks may be submitted now."""
        ...

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Hashable:
        """Begin a task; what stands for it."""
        ...

    def finished(self, seconds: float) -> dict[Hashable, Done]:
        """The tasks that have ended since the last call; waits at most so long for one."""
        ...

    def close(self) -> None:
        """End all processes, whatever they do; again does nothing."""
        ...


class LocalEngine:
    """Processes of this machine.

    Each is a pool of the standard library of its own: where one is killed, its pool is broken, and no other.

    Args:
        workers: how many.
    """

    def __init__(self, workers: int) -> None:
        if workers < 1:
            raise InputError(f"--workers: expected at least 1, found {workers}")
        # Forks of a process that has imported all, and does nothing else, are there at once.
        forks = sys.platform.startswith("linux")
        self._context = multiprocessing.get_context("forkserver" if forks else "spawn")
        if forks:
            self._context.set_forkserver_preload([_MODULE])
        self._before = set(multiprocessing.active_children())
        self._pools = [self._pool() for _ in range(workers)]
        self._running: dict[Future[Any], int] = {}

    def room(self) -> int:
        """See :class:`Engine`."""
        return len(self._pools) - len(self._running)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Hashable:
        """See :class:`Engine`."""
        slot = min(set(range(len(self._pools))) - set(self._running.values()))
        with deaf_children():
            try:
                future = self._pools[slot].submit(function, *arguments)
            except BrokenProcessPool:
                # Killed while it had nothing to do.
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
        return ProcessPoolExecutor(1, self._context, _begin)

    def _renew(self, slot: int) -> None:
        self._pools[slot].shutdown(wait=False)
        self._pools[slot] = self._pool()


def _begin() -> None:
    """The first thing that a process of this machine does."""
    # Where it could not be made deaf from its first moment on.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _end)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end(number: int, frame: FrameType | None) -> None:
    remove_unfinished()
    os._exit(128 + number)


def _end_with_parent() -> None:
    # A pool whose owner was killed would wait for its next task for ever.
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        remove_unfinished()
        os._exit(1)


class RayEngine:
    """Processes of a Ray cluster, which see the same folders and have the same version of this package.

    A task is lost with its process or its node; who does it again is decided by who hands them out, not by Ray.

    Args:
        address: of the cluster, such as ``auto``, ``10.0.0.1:6379`` or ``ray://10.0.0.1:10001``; ``local`` starts one
            on this machine.
        cpus: processors that a task takes.
        gpus: likewise.

    Raises:
        InputError: Ray is not installed, or there is no such cluster.
    """

    def __init__(self, address: str, *, cpus: float = 1, gpus: float = 0) -> None:
        self._ray = ray = _import_ray()
        self._begun = not ray.is_initialized()
        if self._begun:
            try:
                ray.init(address=address, log_to_driver=False, logging_level="ERROR", include_dashboard=None)
            except Exception as error:  # whatever it refuses with
                reason = " ".join(str(error).split())[:200]
                raise InputError(
                    f"--ray {address}: expected a Ray cluster, found: {reason}; start one with `ray start --head`, or "
                    "use --workers"
                ) from error
        # What is lost is known to this process and to the disk, and to nobody else.
        self._cpus, self._gpus = cpus, gpus
        self._options = {"num_cpus": cpus, "num_gpus": gpus, "max_retries": 0, "scheduling_strategy": "SPREAD"}
        self._running: dict[Any, None] = {}

    def room(self) -> int:
        """See :class:`Engine`: as many as the cluster can do now, and some that wait."""
        resources = self._ray.cluster_resources()
        slots = resources.get("CPU", 0) / max(self._cpus, 1e-3)
        if self._gpus:
            slots = min(slots, resources.get("GPU", 0) / self._gpus)
        return max(1, int(slots * 1.25) + 1) - len(self._running)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Hashable:
        """See :class:`Engine`."""
        task = self._ray.remote(**self._options)(function).remote(*arguments)
        self._running[task] = None
        return task  # type: ignore[no-any-return]

    def finished(self, seconds: float) -> dict[Hashable, Done]:
        """See :class:`Engine`."""
        if not self._running:
            return {}
        self._ray.wait(list(self._running), num_returns=1, timeout=seconds)
        ready, _ = self._ray.wait(list(self._running), num_returns=len(self._running), timeout=0)
        found: dict[Hashable, Done] = {}
        for task in ready:
            del self._running[task]
            found[task] = self._outcome(task)
        return found

    def _outcome(self, task: Any) -> Done:
        errors = self._ray.exceptions
        try:
            return Done(self._ray.get(task))
        except errors.RayTaskError as error:
            return Done(error=error.cause if isinstance(error.cause, InputError) else error)
        except errors.RayError as error:
            return Done(lost=f"its process or its node was lost ({type(error).__name__})")

    def close(self) -> None:
        """See :class:`Engine`."""
        for task in self._running:
            self._ray.cancel(task, force=True)
        self._running = {}
        if self._begun:
            self._ray.shutdown()
            self._begun = False


def _import_ray() -> Any:
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        raise InputError(
            "--ray: expected the package ray, which is not installed; pip install 'mcdenoise[ray]', or use --workers"
        ) from error
    return ray
