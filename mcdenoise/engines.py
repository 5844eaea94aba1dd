"""Tasks that other processes run: those of this machine, or the workers of a Ray cluster.

Films and rendering hand their tasks to :func:`run_tasks`, which retries those whose workers are lost. A task keeps its
results on the disk, and does not repeat what it finds there. Ray is optional, and imported on first use.
"""

from __future__ import annotations

import multiprocessing
import platform
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from typing import Any, TypeAlias

from mcdenoise.errors import InputError, in_one_line
from mcdenoise.interruption import deaf_children, prepare_worker, start_resource_tracker

# A task that has lost its worker this many times has failed.
MOST_LOSSES = 5

# The answer of a call; or none, and why it failed.
Outcome = tuple[Any, str | None]


@dataclass
class Task:
    """A call that a worker can repeat.

    Args:
        function: of a module that workers can import.
        arguments: which can be pickled.
        on_end: called in this process with the answer, or with ``None`` and why the call failed.
        losses: how many workers it has lost.
    """

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    on_end: Callable[[Any, str | None], object]
    losses: int = 0


def run_tasks(engine: Engine, tasks: deque[Task], on_wait: Callable[[], object] = lambda: None) -> None:
    """Run all tasks; closes the engine at the end.

    Args:
        engine: runs the tasks.
        tasks: they are started from the left; ``on_end`` of a task may add others.
        on_wait: called several times a second.
    """
    running: dict[Future[Outcome], Task] = {}
    with closing(engine):
        while tasks or running:
            while tasks and len(running) < engine.slots:
                task = tasks.popleft()
                running[engine.submit(task.function, *task.arguments)] = task
            for call in wait(running, 0.2, FIRST_COMPLETED).done:
                task = running.pop(call)
                try:
                    outcome = call.result()
                except engine.lost as error:
                    task.losses += 1
                    if task.losses < MOST_LOSSES:
                        tasks.appendleft(task)
                        continue
                    outcome = None, f"its worker was lost, {task.losses} times ({type(error).__name__})"
                except Exception as error:  # an answer that cannot be sent
                    outcome = None, in_one_line(error)
                task.on_end(*outcome)
            on_wait()


def run_each(
    engine: Engine,
    function: Callable[..., Any],
    calls: Iterable[tuple[Any, ...]],
    on_answer: Callable[[Any, Any], object],
) -> list[tuple[Any, str]]:
    """Run a function with each of several arguments; closes the engine at the end.

    Args:
        engine: runs the calls.
        function: of a module that workers can import.
        calls: the arguments of each call, which can be pickled.
        on_answer: called in this process with the arguments of a call and its answer.

    Returns:
        The arguments of each call that failed, and why.
    """
    failed: list[tuple[Any, str]] = []

    def end(call: tuple[Any, ...], answer: Any, reason: str | None) -> None:
        if reason is None:
            on_answer(call, answer)
        else:
            failed.append((call, reason))

    run_tasks(engine, deque(Task(function, call, partial(end, call)) for call in calls))
    return failed


def _call(driver: str, function: Callable[..., Any], *arguments: Any) -> Outcome:
    """In a worker of the driver's version: the answer of a call, or why it failed."""
    try:
        if driver != version("mcdenoise"):
            raise InputError(f"{platform.node()}: expected mcdenoise {driver}, found {version('mcdenoise')}")
        return function(*arguments), None
    except BaseException as error:  # a user's model may even exit, and not every error can be sent
        return None, in_one_line(error)


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
    """Worker processes of this machine, each a pool of its own: one that is killed is lost alone.

    Args:
        workers: number of processes, at least 1; as many calls may run at a time (``slots``).
    """

    # What the future of a call raises if its worker was lost.
    lost: tuple[type[BaseException], ...] = (BrokenExecutor,)

    def __init__(self, workers: int) -> None:
        start_resource_tracker()
        self.slots = workers
        self._last_calls: dict[ProcessPoolExecutor, Future[Outcome] | None] = {_pool(): None for _ in range(workers)}

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Outcome]:
        """Start a call in a free worker; its result is the answer, or ``None`` and why it failed."""
        free = next(pool for pool, call in self._last_calls.items() if call is None or call.done())
        call = _call, version("mcdenoise"), function, *arguments
        with deaf_children():
            try:
                made = free.submit(*call)
            except BrokenExecutor:
                del self._last_calls[free]
                free = _pool()
                made = free.submit(*call)
        self._last_calls[free] = made
        return made

    def close(self) -> None:
        """End all workers, and what they run; a second call does nothing."""
        end_pools(list(self._last_calls))


def end_pools(pools: Sequence[ProcessPoolExecutor], grace: float = 0.3) -> None:
    """End the processes of pools, which have so many seconds to remove the files that they are writing."""
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
        InputError: Ray is not installed, there is no such cluster, or this process is connected to one already.
    """

    # Ray has a queue of its own; this is more than a cluster runs at a time.
    slots = 5000

    def __init__(self, address: str, *, cpus: float = 1, gpus: float = 0) -> None:
        try:
            import ray
            import ray.exceptions

            ray.init(address=address, log_to_driver=False, logging_level="ERROR", include_dashboard=None)
        except Exception as error:  # Ray has no common type of them
            raise InputError(
                f"--workers {address}: expected a number or a Ray cluster, found: {in_one_line(error)}; "
                "pip install 'mcdenoise[ray]', and start one with `ray start --head`"
            ) from error
        self._ray: Any = ray
        self.lost: tuple[type[BaseException], ...] = (ray.exceptions.RayError,)
        # Retries are those of `run_tasks`.
        self._call = ray.remote(num_cpus=cpus, num_gpus=gpus, max_retries=0, scheduling_strategy="SPREAD")(_call)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Outcome]:
        """Start a call; its result is the answer, or ``None`` and why it failed."""
        call: Future[Outcome] = self._call.remote(version("mcdenoise"), function, *arguments).future()
        return call

    def close(self) -> None:
        """Leave the cluster, which ends all calls; a second call does nothing."""
        self._ray.shutdown()


Engine: TypeAlias = LocalEngine | RayEngine
