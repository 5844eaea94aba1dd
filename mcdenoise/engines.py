"""Tasks that other processes run: those of this machine, or the workers of a Ray cluster.

Films and rendering hand their tasks to :func:`run_tasks`, which retries those whose workers are lost. A task keeps its
results on the disk, and does not repeat what it finds there. Ray is optional, and imported on first use.
"""

from __future__ import annotations

import heapq
import itertools
import multiprocessing
import os
import platform
from collections.abc import Callable, Hashable, Iterable
from contextlib import closing, suppress
from dataclasses import dataclass
from importlib.metadata import version
from multiprocessing.connection import Connection, wait
from typing import Any, Protocol

from mcdenoise.errors import InputError
from mcdenoise.interruption import deaf_children, prepare_worker, start_resource_tracker

# A task that lost its worker this many times in a row without advancing has failed.
MOST_LOSSES = 5
_LONGEST = 500
_SECONDS_BETWEEN_POLLS = 0.2
# In this time an interrupted worker removes the file that it is writing.
_SECONDS_TO_END = 0.3


@dataclass(frozen=True)
class Task:
    """A call that a worker can repeat, and what follows from it.

    Args:
        function: of a module that workers can import.
        arguments: which can be pickled.
        on_done: called with the answer; returns further tasks.
        on_failed: called with the reason in one line, if the function raised an error or lost too many workers; returns
            further tasks.
        rank: tasks of a lower rank are started first.
        progress: a value that changes whenever the task advances: one that loses its worker now and then is retried for
            as long as it does. By default only the number of losses counts.
    """

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    on_done: Callable[[Any], Iterable[Task]]
    on_failed: Callable[[str], Iterable[Task]]
    rank: int = 0
    progress: Callable[[], object] = lambda: None


@dataclass(frozen=True)
class Done:
    """How a call ended: with an answer, with an error, or without a word, because the worker was lost."""

    answer: Any = None
    error: BaseException | None = None
    lost: str = ""


class Engine(Protocol):
    """Runs calls in workers, which are other processes."""

    def free_slots(self) -> int:
        """How many calls may be submitted now."""
        ...

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Hashable:
        """Start a call, and return its handle."""
        ...

    def finished(self, seconds: float) -> dict[Hashable, Done]:
        """The calls that ended since the last time, by handle; waits at most ``seconds`` for the first of them."""
        ...

    def close(self) -> None:
        """End all workers, and what they run; a second call does nothing."""
        ...


def run_tasks(engine: Engine, tasks: Iterable[Task], on_wait: Callable[[], object] = lambda: None) -> None:
    """Run tasks, and those that follow from them, until each has succeeded or failed; closes the engine at the end.

    A task whose worker is lost is retried, up to five times in a row without progress.

    Args:
        engine: runs the tasks.
        tasks: started in this order, by rank.
        on_wait: called several times a second.
    """
    counter = itertools.count()
    queue: list[tuple[int, int, _Attempt]] = []
    running: dict[Hashable, tuple[int, int, _Attempt]] = {}

    def add(new: Iterable[Task]) -> None:
        for task in new:
            heapq.heappush(queue, (task.rank, next(counter), _Attempt(task, task.progress())))

    with closing(engine):
        add(tasks)
        while queue or running:
            for _ in range(min(len(queue), engine.free_slots()) if queue else 0):
                place = heapq.heappop(queue)
                task = place[-1].task
                running[engine.submit(task.function, *task.arguments)] = place
            for handle, done in engine.finished(_SECONDS_BETWEEN_POLLS).items():
                place = running.pop(handle)
                attempt = place[-1]
                if attempt.is_repeated(done):
                    heapq.heappush(queue, place)
                elif done.lost:
                    add(attempt.task.on_failed(f"{done.lost}, {attempt.losses} times in a row"))
                elif done.error is not None:
                    add(attempt.task.on_failed(describe_error(done.error)))
                else:
                    add(attempt.task.on_done(done.answer))
            on_wait()


@dataclass
class _Attempt:
    task: Task
    progress: object
    losses: int = 0

    def is_repeated(self, done: Done) -> bool:
        """Whether the task lost its worker and is tried again."""
        if not done.lost:
            return False
        before, self.progress = self.progress, self.task.progress()
        self.losses = 1 if self.progress != before else self.losses + 1
        return self.losses < MOST_LOSSES


def describe_error(error: BaseException) -> str:
    """One line that says why a task failed."""
    text = " ".join(str(error).split())
    return text if isinstance(error, InputError) else f"{type(error).__name__}: {text}"[:_LONGEST]


def processors() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def parse_workers(text: str) -> int | None:
    """The number of processes that ``--workers`` asks for; ``None`` if it is the address of a Ray cluster.

    Raises:
        InputError: the number is less than 1.
    """
    try:
        count = int(text)
    except ValueError:
        return None
    if count < 1:
        raise InputError(f"--workers: expected at least 1, or the address of a Ray cluster, found {count}")
    return count


def open_engine(workers: str, *, cpus: float = 1, gpus: float = 0) -> Engine:
    """The engine that ``--workers`` asks for.

    Args:
        workers: number of processes of this machine, or the address of a Ray cluster.
        cpus: see :class:`RayEngine`.
        gpus: see :class:`RayEngine`.

    Raises:
        InputError: the number is less than 1; or see :class:`RayEngine`.
    """
    count = parse_workers(workers)
    return RayEngine(workers, cpus=cpus, gpus=gpus) if count is None else LocalEngine(count)


class LocalEngine:
    """Worker processes of this machine.

    Each has a pipe of its own, and shares no lock, server or queue with others: one that is killed is lost alone.

    Args:
        workers: number of processes, at least 1.
    """

    def __init__(self, workers: int) -> None:
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
    """A process that runs the calls which it gets through a pipe, until the pipe is closed."""

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
    """In a worker: run calls."""
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


class RayEngine:
    """Workers of a Ray cluster, which see the same folders and have the same version of this package.

    Args:
        address: of the cluster, such as ``auto``, ``10.0.0.1:6379`` or ``ray://10.0.0.1:10001``; ``local`` starts one
            on this machine.
        cpus: processors that a call takes.
        gpus: GPUs that a call takes.

    Raises:
        InputError: Ray is not installed, or there is no such cluster.
    """

    def __init__(self, address: str, *, cpus: float = 1, gpus: float = 0) -> None:
        try:
            import ray
            import ray.exceptions
        except ImportError as error:
            raise InputError(
                f"--workers {address}: expected a number, or the package ray for a cluster, which is not installed; "
                "pip install 'mcdenoise[ray]'"
            ) from error
        self._ray: Any = ray
        self._begun = not ray.is_initialized()
        if self._begun:
            try:
                ray.init(address=address, log_to_driver=False, logging_level="ERROR", include_dashboard=None)
            except Exception as error:  # Ray has no common type of them
                reason = " ".join(str(error).split())[:200]
                raise InputError(
                    f"--workers {address}: expected a number or a Ray cluster, found: {reason}; start one with "
                    "`ray start --head`"
                ) from error
        self._cpus, self._gpus = cpus, gpus
        # Not Ray but `run_tasks` retries, which knows what the task has finished.
        options = {"num_cpus": cpus, "num_gpus": gpus, "max_retries": 0, "scheduling_strategy": "SPREAD"}
        self._call = self._ray.remote(**options)(_call)
        self._running: list[Any] = []

    def free_slots(self) -> int:
        """See :class:`Engine`: as many as the cluster can run now, and some that wait for it."""
        resources = self._ray.cluster_resources()
        slots = resources.get("CPU", 0) / max(self._cpus, 1e-3)
        if self._gpus:
            slots = min(slots, resources.get("GPU", 0) / self._gpus)
        return max(1, int(slots * 1.25) + 1) - len(self._running)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Hashable:
        """See :class:`Engine`."""
        self._running.append(self._call.remote(version("mcdenoise"), function, *arguments))
        return self._running[-1]  # type: ignore[no-any-return]

    def finished(self, seconds: float) -> dict[Hashable, Done]:
        """See :class:`Engine`."""
        if not self._running:
            return {}
        self._ray.wait(self._running, num_returns=1, timeout=seconds)
        ready, self._running = self._ray.wait(self._running, num_returns=len(self._running), timeout=0)
        return {call: self._outcome(call) for call in ready}

    def _outcome(self, call: Any) -> Done:
        errors = self._ray.exceptions
        try:
            return Done(self._ray.get(call))
        except errors.RayTaskError as error:
            return Done(error=error.cause if isinstance(error.cause, InputError) else error)
        except errors.RayError as error:
            return Done(lost=f"its worker or its node was lost ({type(error).__name__})")

    def close(self) -> None:
        """See :class:`Engine`."""
        for call in self._running:
            self._ray.cancel(call, force=True)
        self._running = []
        if self._begun:
            self._ray.shutdown()
            self._begun = False


def _call(driver: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """In a worker: run a call, if it is of the same version as the driver."""
    if driver != version("mcdenoise"):
        raise InputError(
            f"mcdenoise: expected version {driver}, as the driver has, found {version('mcdenoise')} on "
            f"{platform.node()}; install the same version on all machines"
        )
    return function(*arguments)
