"""Times of several calls that take turns, so that other work of the machine affects all of them equally."""

from __future__ import annotations

import time
from collections.abc import Callable


def interleaved(calls: dict[str, Callable[[], object]], rounds: int) -> dict[str, list[float]]:
    """Measure calls that take turns.

    Args:
        calls: by name; every round makes each of them once, in this order.
        rounds: number of rounds after a first one, which warms up.

    Returns:
        Milliseconds of each call by name: of the first round, then of the others.
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds + 1):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            times[name].append((time.perf_counter() - start) * 1e3)
    return times
