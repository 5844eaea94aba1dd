"""Time stamps of work on a device."""

from __future__ import annotations

import time
from typing import Any, TypeAlias

import torch

# A time stamp: milliseconds on a CPU, an event on a GPU.
Moment: TypeAlias = Any


class Stopwatch:
    """Takes time stamps without waiting for the device: CUDA events on a GPU, otherwise the clock.

    Args:
        device: where the work runs.
    """

    def __init__(self, device: torch.device | str) -> None:
        self._device = torch.device(device)

    @property
    def runs_behind(self) -> bool:
        """Whether time stamps are asynchronous, so that reading one waits for the device."""
        return self._device.type == "cuda"

    def mark(self) -> Moment:
        """A time stamp: now, or on a GPU the moment at which all work queued so far is done."""
        if not self.runs_behind:
            return time.perf_counter() * 1e3
        event = torch.cuda.Event(enable_timing=True)
        event.record(torch.cuda.current_stream(self._device))
        return event

    def wait(self, moment: Moment) -> None:
        """Wait until a time stamp has been reached."""
        if self.runs_behind:
            moment.synchronize()

    def between(self, start: Moment, end: Moment) -> float:
        """Milliseconds between two time stamps; waits for the second one."""
        if not self.runs_behind:
            return float(end - start)
        self.wait(end)
        return float(start.elapsed_time(end))
