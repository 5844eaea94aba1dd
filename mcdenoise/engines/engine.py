"""The interface of an engine."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any, Protocol

from mcdenoise.errors import InputError

# A task that lost its worker this many times in a row without advancing has failed.
MOST_LOSSES = 5
_LONGEST = 500


@dataclass(frozen=True)
class Done:
    """How a task ended.

    Args:
        answer: value that the function returned.
        error: exception that it raised.
        lost: why there is neither: the worker died.
    """

    answer: Any = None
    error: BaseException | None = None
    lost: str = ""


class Engine(Protocol):
    """Runs tasks in workers, which are other processes, and reports how each task ended."""

    def free_slots(self) -> int:
        """How many tasks may be submitted now."""
        ...

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Hashable:
        """Start a task.

        Args:
            function: of a module that workers can import.
            arguments: which can be pickled.

        Returns:
            A handle of the task.
        """
        ...

    def finished(self, seconds: float) -> dict[Hashable, Done]:
        """The tasks that ended since the last call, by handle; waits at most ``seconds`` for the first of them."""
        ...

    def close(self) -> None:
        """End all workers, and the tasks that they run; a second call does nothing."""
        ...


def describe_error(error: BaseException) -> str:
    """One line that says why a task failed."""
    text = " ".join(str(error).split())
    return text if isinstance(error, InputError) else f"{type(error).__name__}: {text}"[:_LONGEST]
