"""Engines run tasks in other processes: those of this machine, or the workers of a Ray cluster.

Films and rendering hand their tasks to an engine; :func:`run_tasks` retries the tasks of lost workers.
"""

from mcdenoise.engines.cluster import RayEngine
from mcdenoise.engines.engine import MOST_LOSSES, Done, Engine, describe_error
from mcdenoise.engines.local import LocalEngine, processors
from mcdenoise.engines.tasks import Task, run_tasks

__all__ = [
    "MOST_LOSSES",
    "Done",
    "Engine",
    "LocalEngine",
    "RayEngine",
    "Task",
    "describe_error",
    "processors",
    "run_tasks",
]
