"""When a device did what it was told to do."""

from __future__ import annotations

import time
from typing import Any, TypeAlias

import torch

# What a stopwatch marks: a number of milliseconds, or an event of a GPU.
Moment: TypeAlias = Any


class Stopwatch:
    """Marks moments of a device without waiting for it: by CUDA events on a GPU, else by the clock.

    Args:
        device: where the work is done.
    """

    def __init__(self, device: torch.device | str) -> None:
        self._device = torch.device(device)

    @property
    def runs_behind(self) -> bool:
        """Whether what was marked is known only later, so that asking for it waits."""
        return self._device.type == "cuda"

    def mark(self) -> Moment:
        """Now; on a GPU, when it will have done what it was told to do so far."""
        if not self.runs_behind:
            return time.perf_counter() * 1e3
        event = torch.cuda.Event(enable_timing=True)
        event.record(torch.cuda.current_stream(self._device))
        return event

    def wait(self, moment: Moment) -> None:
        """Until a moment has come."""
        if self.runs_behind:
            moment.synchronize()

    def between(self, start: Moment, end: Moment) -> float:
        """Milliseconds from one moment to another; waits until the latter has come."""
        if not self.runs_behind:
            return float(end - start)
        self.wait(end)
        return float(start.elapsed_time(end))
