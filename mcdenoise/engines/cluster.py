"""Tasks run by a Ray cluster; Ray is optional and imported on first use."""

from __future__ import annotations

import platform
from collections.abc import Callable, Hashable
from importlib.metadata import version
from typing import Any

from mcdenoise.engines.engine import Done
from mcdenoise.errors import InputError


class RayEngine:
    """Workers of a Ray cluster, which see the same folders and have the same version of this package.

    A task is lost with its worker or its node. The driver decides whether it is retried, not Ray.

    Args:
        address: of the cluster, such as ``auto``, ``10.0.0.1:6379`` or ``ray://10.0.0.1:10001``; ``local`` starts one
            on this machine.
        cpus: processors that a task takes.
        gpus: GPUs that a task takes.

    Raises:
        InputError: Ray is not installed, or there is no such cluster.
    """

    def __init__(self, address: str, *, cpus: float = 1, gpus: float = 0) -> None:
        self._ray = ray = _import_ray()
        self._begun = not ray.is_initialized()
        if self._begun:
            try:
                ray.init(address=address, log_to_driver=False, logging_level="ERROR", include_dashboard=None)
            except Exception as error:  # Ray has no common type of them
                reason = " ".join(str(error).split())[:200]
                raise InputError(
                    f"--ray {address}: expected a Ray cluster, found: {reason}; start one with `ray start --head`, or "
                    "use --workers"
                ) from error
        # The driver retries, because it knows from the disk which results are finished.
        self._cpus, self._gpus = cpus, gpus
        options = {"num_cpus": cpus, "num_gpus": gpus, "max_retries": 0, "scheduling_strategy": "SPREAD"}
        self._call = ray.remote(**options)(_call)
        self._running: dict[Any, None] = {}

    def free_slots(self) -> int:
        """See :class:`Engine`: as many as the cluster can run now, and some that wait for it."""
        resources = self._ray.cluster_resources()
        slots = resources.get("CPU", 0) / max(self._cpus, 1e-3)
        if self._gpus:
            slots = min(slots, resources.get("GPU", 0) / self._gpus)
        return max(1, int(slots * 1.25) + 1) - len(self._running)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Hashable:
        """See :class:`Engine`."""
        task = self._call.remote(version("mcdenoise"), function, *arguments)
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
            return Done(lost=f"its worker or its node was lost ({type(error).__name__})")

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


def _call(driver: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """In a worker: run a task, if it is of the same version as the driver."""
    if driver != version("mcdenoise"):
        raise InputError(
            f"mcdenoise: expected version {driver}, as the driver has, found {version('mcdenoise')} on "
            f"{platform.node()}; install the same version on all machines"
        )
    return function(*arguments)
