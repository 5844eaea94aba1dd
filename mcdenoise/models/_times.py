"""Time stamps of work on a device, and run times of a method's parts, as hooks on its modules see them from outside."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import Any, TypeAlias

import torch
from torch import nn

from mcdenoise.models._interface import Model
from mcdenoise.models._wrapper import Wrapper, name_of
from mcdenoise.models.chain import Chain
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.models.oidn import Oidn

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


class Times:
    """Run times of the stages of one frame, each without the stages inside it.

    The host does not wait for a GPU: the GPU records the times itself, and :meth:`milliseconds` reads them.

    Args:
        device: where the stages run.
    """

    def __init__(self, device: torch.device) -> None:
        self._watch, self._thread = Stopwatch(device), threading.get_ident()
        self._open: list[str] = []
        # The innermost stage from each moment on, none between blocks; and all stages in the order of the report.
        self._changes: list[tuple[str, Moment]] = []
        self._stages: list[str] = []

    @contextmanager
    def of(self, stage: str) -> Iterator[None]:
        """Measure what runs inside this block."""
        self._begin(stage)
        try:
            yield
        finally:
            self._end()
            self._stages.append(stage)

    @contextmanager
    def of_modules(self, modules: Iterable[tuple[nn.Module, str]]) -> Iterator[None]:
        """Measure these modules, each with the name of its stage, while they run inside this block."""
        handles = []
        for module, stage in modules:

            def begin(*_: object, stage: str = stage) -> None:
                # Another thread may run the same module for a denoiser of its own.
                if threading.get_ident() == self._thread:
                    self._stages.append(stage)
                    self._begin(stage)

            def end(*_: object) -> None:
                if threading.get_ident() == self._thread:
                    self._end()

            handles += [
                module.register_forward_pre_hook(begin),
                module.register_forward_hook(end, always_call=True),
            ]
        try:
            yield
        finally:
            for handle in handles:
                handle.remove()

    def milliseconds(self) -> dict[str, float]:
        """The times by stage, in the order of their beginning; a block's is at its end. Waits for a GPU."""
        found = dict.fromkeys(self._stages, 0.0)
        for (stage, start), (_, end) in pairwise(self._changes):
            if stage in found:
                found[stage] += self._watch.between(start, end)
        return found

    def _begin(self, stage: str) -> None:
        self._open.append(stage)
        self._changes.append((stage, self._watch.mark()))

    def _end(self) -> None:
        # If another hook fails before the stage begins, this is called all the same.
        if self._open:
            self._open.pop()
            self._changes.append((self._open[-1] if self._open else "", self._watch.mark()))


def stages_of(model: Model, name: str) -> Iterator[tuple[nn.Module, str]]:
    """The wrappers of a model, and the methods inside and in chains, with the names of their stages.

    Args:
        model: any.
        name: the stage of methods without weights.
    """
    for part in model.modules() if isinstance(model, nn.Module) else ():
        if isinstance(part, Chain):
            own: Iterator[Any] = part.children()
            yield from ((each, _stage(each, name_of(each))) for each in own if _is_method(each))
        elif isinstance(part, Wrapper):
            inner: object = part.inner
            method = _stage(inner, name) if _is_method(inner) else part.stage
            # Demodulated calls what is inside without its hooks, and takes hardly any time itself.
            yield part, method if isinstance(part, Demodulated) else part.stage
            if isinstance(inner, nn.Module) and _is_method(inner):
                yield inner, method


def _is_method(thing: object) -> bool:
    return isinstance(thing, nn.Module) and not isinstance(thing, Wrapper | Chain)


def _stage(method: Any, name: str) -> str:
    has_weights = isinstance(method, Oidn) or next(method.parameters(), None) is not None
    # A user's network may call a layer so.
    own = getattr(method, "stage", None)
    return own if isinstance(own, str) else "network" if has_weights else name
