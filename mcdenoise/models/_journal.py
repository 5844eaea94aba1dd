"""Reports about denoising a frame: run times, and what was skipped and why.

Methods are pure functions. They report beside their results, to the active :class:`Journal` if there is one. Reporting
never makes the host wait for a GPU: values are copied asynchronously when the frame is done, and read when the report
is read or when the next frame begins.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import torch
from torch import Tensor

from mcdenoise.models._reads import at_hand
from mcdenoise.models._stopwatch import Moment, Stopwatch

# Handles numbers once they have been read from the device.
Tell: TypeAlias = Callable[[Sequence[float]], None]


@dataclass(frozen=True)
class Stage:
    """One stage of denoising a frame.

    Args:
        name: such as ``reproject``.
        skipped: fraction of the stage that was skipped.
        reason: why it was skipped, or why it was not.
        exact: whether skipping leaves the pixels unchanged; otherwise they agree up to the tolerance.
    """

    name: str
    skipped: float
    reason: str
    exact: bool = True


@dataclass
class _Span:
    """Start and end of one run of a stage, with the runs that were timed inside it."""

    stage: str
    watch: Stopwatch
    start: Moment
    end: Moment = None
    within: list[_Span] = field(default_factory=list)

    @property
    def milliseconds(self) -> float:
        return self.watch.between(self.start, self.end)

    @property
    def own(self) -> float:
        return self.milliseconds - sum(span.milliseconds for span in self.within)


@dataclass
class Journal:
    """The report of one frame. For a frame on a GPU it is complete after :meth:`settle`.

    Args:
        milliseconds: run time of each stage; under the model's name what it spends outside of its stages.
        stages: how much of each stage was skipped, and why, by name.
        reset: why the history was discarded; empty if it was used.
        tiles: how the image was divided into tiles, and why.
        history: fraction of the pixels that have a history; ``None`` if no history was looked up.
        fireflies: fraction of the light that was clamped in fireflies.
    """

    milliseconds: dict[str, float] = field(default_factory=dict)
    stages: dict[str, Stage] = field(default_factory=dict)
    reset: str = ""
    tiles: str = ""
    history: float | None = None
    fireflies: float = 0.0

    def __post_init__(self) -> None:
        # These are no dataclass fields, because a written report must not contain them.
        self._open: list[_Span] = []
        self._spans: list[_Span] = []
        self._asked: list[tuple[Tensor, Tell]] = []
        self._sent: tuple[Tensor, Stopwatch, Moment] | None = None

    def note(self, name: str, reason: str, skipped: float = 0.0, *, exact: bool = True) -> None:
        """Add a :class:`Stage`; it replaces an earlier one of the same name."""
        self.stages[name] = Stage(name, float(skipped), reason, exact)

    @contextmanager
    def timed(self, stage: str, device: torch.device) -> Iterator[None]:
        """See :func:`timed`."""
        watch = Stopwatch(device)
        span = _Span(stage, watch, watch.mark())
        self._open.append(span)
        try:
            yield
        finally:
            self._open.pop()
        span.end = watch.mark()
        if self._open:
            self._open[-1].within.append(span)
        self._spans.append(span)
        if not watch.runs_behind:
            self._add_times()

    def ask(self, values: Tensor, tell: Tell) -> None:
        """See :func:`ask`."""
        self._asked.append((values.detach().reshape(-1), tell))

    def send(self) -> None:
        """Start copying all requested values to the host in one piece, without waiting for it."""
        if not self._asked:
            return
        values = torch.cat([values for values, _ in self._asked])
        watch = Stopwatch(values.device)
        self._sent = values.to("cpu", non_blocking=True), watch, watch.mark()

    def settle(self) -> None:
        """Fill in the values that were still on the device; this waits for the device.

        Raises:
            Exception: the first exception that a handler raised, after all handlers have run.
        """
        self._add_times()
        sent, asked = self._sent, self._asked
        self._sent, self._asked = None, []
        if sent is None:
            return
        values, watch, moment = sent
        watch.wait(moment)
        numbers, failures = iter(values.tolist()), []
        for part, tell in asked:
            own = [next(numbers) for _ in range(len(part))]
            try:
                tell(own)
            except Exception as error:  # an exception of one handler must not keep the others from running
                failures.append(error)
        if failures:
            raise failures[0]

    def _add_times(self) -> None:
        spans, self._spans = self._spans, []
        for span in spans:
            self.milliseconds[span.stage] = self.milliseconds.get(span.stage, 0.0) + span.own


_listening: ContextVar[Journal | None] = ContextVar("listening", default=None)


@contextmanager
def listening(journal: Journal) -> Iterator[None]:
    """Collect the reports of this thread's methods in a journal inside this block."""
    token = _listening.set(journal)
    try:
        yield
    finally:
        _listening.reset(token)
    journal.send()


def journal() -> Journal | None:
    """The active journal, or ``None``."""
    return None if torch.compiler.is_compiling() else _listening.get()


def note(name: str, reason: str, skipped: float = 0.0, *, exact: bool = True) -> None:
    """Report a :class:`Stage`; it replaces an earlier one of the same name."""
    if (found := journal()) is not None:
        found.note(name, reason, skipped, exact=exact)


def ask(values: Tensor, tell: Tell) -> None:
    """Request values that a device computes: handled at once if the host can read them, else in :meth:`Journal.settle`.

    Args:
        values: any number of them, of any shape.
        tell: handles the values in memory order; may raise. Without an active journal it is not called for values on
            a GPU.
    """
    if at_hand(values.device):
        tell(values.detach().reshape(-1).tolist())
    elif (found := journal()) is not None:
        found.ask(values, tell)


def tell_history(fraction: Tensor) -> None:
    """Report the fraction of the pixels that have a history, a tensor of one number."""
    if (found := journal()) is None:
        return

    def tell(fraction: Sequence[float]) -> None:
        (found.history,) = fraction

    ask(fraction, tell)


def timed(stage: str, device: torch.device) -> AbstractContextManager[None]:
    """Measure the run time of a stage. A stage that is timed inside it counts separately.

    Args:
        stage: its name.
        device: where it runs. The host does not wait for a GPU: the GPU records the time itself, which is read when the
            journal is settled.
    """
    found = journal()
    return nullcontext() if found is None else found.timed(stage, device)


def summarize(frames: list[list[Stage]]) -> list[dict[str, Any]]:
    """Summarize what was skipped in a shot.

    Args:
        frames: the stages of each frame.

    Returns:
        For each stage, in order: ``stage``; ``kept``, false if all of it was skipped in all frames; ``skipped``, the
        mean fraction, from 0 to 1; ``reason``, the most frequent reason for skipping it, or else for computing it; and
        ``exact``.
    """
    rows = []
    for name in dict.fromkeys(stage.name for stages in frames for stage in stages):
        found = [stage for stages in frames for stage in stages if stage.name == name]
        fraction = sum(stage.skipped for stage in found) / len(frames)
        telling = [stage for stage in found if stage.skipped > 0] or found
        reason = Counter(stage.reason for stage in telling).most_common(1)[0][0]
        rows.append(
            {"stage": name, "kept": fraction < 1, "skipped": fraction, "reason": reason, "exact": found[0].exact}
        )
    return rows
