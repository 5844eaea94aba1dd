"""Tasks that other processes run: those of this machine, or the workers of a Ray cluster.

Films and rendering hand their tasks to :func:`run_jobs`, which retries those whose workers are lost. A task keeps its
results on the disk, and does not repeat what it finds there. Ray is optional, and imported on first use.
"""

from __future__ import annotations

import heapq
import itertools
import multiprocessing
import os
import platform
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from contextlib import closing
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any, TypeAlias

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
    """A call that a worker can repeat.

    Args:
        function: of a module that workers can import.
        arguments: which can be pickled.
        rank: tasks of a lower rank are started first.
        progress: a value that changes whenever the task advances: one that loses its worker now and then is retried for
            as long as it does. By default only the number of losses counts.
    """

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    rank: int = 0
    progress: Callable[[], object] = lambda: None


# The answer of a call; or none, and why it failed.
Outcome = tuple[Any, str | None]
# It yields tasks, which run side by side, and is sent the outcome of each.
Job = Generator[Sequence[Task], list[Outcome], None]


def run_jobs(engine: Engine, jobs: Iterable[Job], on_wait: Callable[[], object] = lambda: None) -> None:
    """Run jobs side by side until each has ended; closes the engine at the end.

    A task whose worker is lost is retried, up to five times in a row without progress.

    Args:
        engine: runs the tasks.
        jobs: their tasks are started in this order, by rank.
        on_wait: called several times a second.
    """
    numbers = itertools.count()
    queue: list[_Attempt] = []
    running: dict[Future[Outcome], _Attempt] = {}

    def advance(job: Job, outcomes: list[Outcome] | None = None) -> None:
        """Let a job yield its next tasks."""
        tasks: Sequence[Task] = ()
        try:
            while not tasks:
                tasks, outcomes = next(job) if outcomes is None else job.send(outcomes), []
        except StopIteration:
            return
        together: list[Outcome | None] = [None] * len(tasks)
        for place, task in enumerate(tasks):
            heapq.heappush(queue, _Attempt(task.rank, next(numbers), task, job, together, place, task.progress()))

    with closing(engine):
        for job in jobs:
            advance(job)
        while queue or running:
            while queue and len(running) < engine.slots():
                attempt = heapq.heappop(queue)
                running[engine.submit(attempt.task.function, *attempt.task.arguments)] = attempt
            for call in wait(running, _SECONDS_BETWEEN_POLLS, FIRST_COMPLETED).done:
                attempt = running.pop(call)
                outcome = attempt.together[attempt.place] = attempt.outcome(call, engine.lost)
                if outcome is None:
                    heapq.heappush(queue, attempt)
                ended = [each for each in attempt.together if each is not None]
                if len(ended) == len(attempt.together):
                    advance(attempt.job, ended)
            on_wait()


def run_tasks(
    engine: Engine,
    function: Callable[..., Any],
    calls: Iterable[tuple[Any, ...]],
    on_answer: Callable[[tuple[Any, ...], Any], object],
) -> list[tuple[tuple[Any, ...], str]]:
    """Call a function once for each tuple of arguments, each call a task of its own; closes the engine at the end.

    Args:
        engine: runs the calls.
        function: of a module that workers can import.
        calls: the arguments of each call.
        on_answer: called with the arguments and the answer of a call that did not fail.

    Returns:
        The arguments of the calls that failed, and why.
    """
    failed: list[tuple[tuple[Any, ...], str]] = []

    def one(arguments: tuple[Any, ...]) -> Job:
        [(answer, reason)] = yield [Task(function, arguments)]
        if reason is None:
            on_answer(arguments, answer)
        else:
            failed.append((arguments, reason))

    run_jobs(engine, map(one, calls))
    return failed


@dataclass(order=True)
class _Attempt:
    """A task, its job, and the outcomes of the tasks that were yielded together; in the order of their start."""

    rank: int
    number: int
    task: Task = field(compare=False)
    job: Job = field(compare=False)
    together: list[Outcome | None] = field(compare=False)
    place: int = field(compare=False)
    progress: object = field(compare=False)
    losses: int = field(default=0, compare=False)

    def outcome(self, call: Future[Outcome], lost: tuple[type[BaseException], ...]) -> Outcome | None:
        """The outcome; ``None`` if the task has lost its worker and is to be tried again."""
        try:
            return call.result()
        except lost as error:
            before, self.progress = self.progress, self.task.progress()
            self.losses = 1 if self.progress != before else self.losses + 1
            if self.losses < MOST_LOSSES:
                return None
            return None, f"its worker was lost, {self.losses} times in a row ({type(error).__name__})"
        except Exception as error:  # an answer that cannot be sent
            return None, describe_error(error)


def _call(driver: str, function: Callable[..., Any], *arguments: Any) -> Outcome:
    """In a worker of the driver's version: the answer of a call, or why it failed."""
    try:
        if driver != version("mcdenoise"):
            raise InputError(
                f"mcdenoise: expected version {driver}, as the driver has, found {version('mcdenoise')} on "
                f"{platform.node()}; install the same version on all machines"
            )
        return function(*arguments), None
    except BaseException as error:  # a user's model may even exit, and not every error can be sent
        return None, describe_error(error)


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


class LocalEngine:
    """Worker processes of this machine.

    Each is a pool of its own, and shares no queue with others: one that is killed is lost alone.

    Args:
        workers: number of processes, at least 1.
    """

    # What the future of a call raises if its worker was lost.
    lost: tuple[type[BaseException], ...] = (BrokenExecutor,)

    def __init__(self, workers: int) -> None:
        start_resource_tracker()
        self._pools = [_pool() for _ in range(workers)]
        self._calls: list[Future[Outcome] | None] = [None] * workers

    def slots(self) -> int:
        """How many calls may run at a time."""
        return len(self._pools)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Outcome]:
        """Start a call in a free worker; its result is the answer, or ``None`` and why it failed."""
        free = next(place for place, call in enumerate(self._calls) if call is None or call.done())
        call = _call, version("mcdenoise"), function, *arguments
        with deaf_children():
            try:
                self._calls[free] = made = self._pools[free].submit(*call)
            except BrokenExecutor:
                self._pools[free] = _pool()
                self._calls[free] = made = self._pools[free].submit(*call)
        return made

    def close(self) -> None:
        """End all workers, and what they run; a second call does nothing."""
        end_pools(self._pools)
        self._pools, self._calls = [], []


def end_pools(pools: Sequence[ProcessPoolExecutor], grace: float = _SECONDS_TO_END) -> None:
    """End the processes of pools, and what they run, at the latest after so many seconds."""
    processes = [process for pool in pools for process in (pool._processes or {}).values()]
    for pool in pools:
        pool.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        process.terminate()
    for process in processes:
        process.join(grace / len(processes))
        process.kill()


def _pool() -> ProcessPoolExecutor:
    # A fork of a process with threads may hold their locks for ever.
    return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=prepare_worker)


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
        self.lost: tuple[type[BaseException], ...] = (ray.exceptions.RayError,)
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
        # Not Ray but `run_jobs` retries, which knows what the task has finished.
        options = {"num_cpus": cpus, "num_gpus": gpus, "max_retries": 0, "scheduling_strategy": "SPREAD"}
        self._call = ray.remote(**options)(_call)
        self._calls: dict[Future[Outcome], Any] = {}

    def slots(self) -> int:
        """How many calls may run or wait at a time: some more than the cluster can run now."""
        resources = self._ray.cluster_resources()
        slots = resources.get("CPU", 0) / max(self._cpus, 1e-3)
        if self._gpus:
            slots = min(slots, resources.get("GPU", 0) / self._gpus)
        return max(1, int(slots * 1.25) + 1)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Outcome]:
        """Start a call; its result is the answer, or ``None`` and why it failed."""
        call = self._call.remote(version("mcdenoise"), function, *arguments)
        self._calls = {future: each for future, each in self._calls.items() if not future.done()}
        future: Future[Outcome] = call.future()
        self._calls[future] = call
        return future

    def close(self) -> None:
        """End all calls; a second one does nothing."""
        for future, call in self._calls.items():
            if not future.done():
                self._ray.cancel(call, force=True)
        self._calls = {}
        if self._begun:
            self._ray.shutdown()
            self._begun = False


Engine: TypeAlias = LocalEngine | RayEngine


def open_engine(workers: str, *, cpus: float = 1, gpus: float = 0) -> Engine:
    """The engine that ``--workers`` asks for: see :func:`parse_workers` and :class:`RayEngine`."""
    count = parse_workers(workers)
    return RayEngine(workers, cpus=cpus, gpus=gpus) if count is None else LocalEngine(count)
