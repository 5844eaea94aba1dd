"""What happened while a frame was denoised: run times, and what was skipped and why.

Methods are pure; what they report goes beside their results to whoever listens, and to nobody otherwise. On a device
whose values are not at hand nothing is waited for meanwhile: what is to be known of them is copied at once when the
frame is done, and read when somebody asks, or when the next frame comes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import torch
from torch import Tensor

from mcdenoise.models._reads import at_hand
from mcdenoise.models._stopwatch import Moment, Stopwatch

# What is done with numbers once they are read.
Tell: TypeAlias = Callable[[Sequence[float]], None]


@dataclass(frozen=True)
class Stage:
    """One stage of denoising a frame.

    Args:
        name: such as ``reproject``.
        skipped: the fraction of it that was skipped.
        reason: why, or why not.
        exact: whether the pixels are the same without it; else they agree to the tolerance.
    """

    name: str
    skipped: float
    reason: str
    exact: bool = True


@dataclass
class _Span:
    """Of a stage: from when to when, and what was timed within it."""

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
    """What is reported of one frame; of a frame on a GPU it is complete once it was settled.

    Args:
        milliseconds: run time of each stage.
        stages: what was skipped of them, and why, by name.
        reset: why the history was not used; empty where it was.
        tiles: the parts of the image that were computed, and why those.
        history: the fraction of the pixels that found themselves in the frame before; ``None`` where nothing was looked
            for.
    """

    milliseconds: dict[str, float] = field(default_factory=dict)
    stages: dict[str, Stage] = field(default_factory=dict)
    reset: str = ""
    tiles: str = ""
    history: float | None = None

    def __post_init__(self) -> None:
        # No fields: whoever writes a report down has no use for what it is made from.
        self._open: list[_Span] = []
        self._spans: list[_Span] = []
        self._asked: list[tuple[Tensor, Tell]] = []
        self._sent: tuple[Tensor, Stopwatch, Moment] | None = None

    def note(self, name: str, reason: str, skipped: float = 0.0, *, exact: bool = True) -> None:
        """Add a :class:`Stage`; the last word on each counts."""
        self.stages[name] = Stage(name, float(skipped), reason, exact)

    @contextmanager
    def timed(self, stage: str, device: torch.device, *, unless_told: bool = False) -> Iterator[None]:
        """See :func:`timed`; ``unless_told``: the stage counts only if nothing is timed within it."""
        watch = Stopwatch(device)
        span = _Span(stage, watch, watch.mark())
        self._open.append(span)
        try:
            yield
        finally:
            self._open.pop()
        span.end = watch.mark()
        if self._open:
            self._open[-1].within += span.within if unless_told and span.within else [span]
        if unless_told and span.within:
            return
        self._spans.append(span)
        if not watch.runs_behind:
            self._add_times()

    def ask(self, values: Tensor, tell: Tell) -> None:
        """See :func:`ask`."""
        self._asked.append((values.detach().reshape(-1), tell))

    def send(self) -> None:
        """Have all that was asked for copied to the host in one piece, and do not wait for it."""
        if not self._asked:
            return
        values = torch.cat([values for values, _ in self._asked])
        watch = Stopwatch(values.device)
        self._sent = values.to("cpu", non_blocking=True), watch, watch.mark()

    def settle(self) -> None:
        """Fill in what was not known yet; waits for the device.

        Raises:
            Exception: what one of those raises that wait for numbers, after all were told.
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
            except Exception as error:  # whatever is wrong with one must not hide the others
                failures.append(error)
        if failures:
            raise failures[0]

    def _add_times(self) -> None:
        spans, self._spans = self._spans, []
        for span in spans:
            self.milliseconds[span.stage] = self.milliseconds.get(span.stage, 0.0) + span.own


_listening: list[Journal] = []


@contextmanager
def listening(journal: Journal) -> Iterator[None]:
    """Collect in a journal what methods report."""
    _listening.append(journal)
    try:
        yield
    finally:
        _listening.pop()
    journal.send()


def journal() -> Journal | None:
    """The journal of whoever listens."""
    return _listening[-1] if _listening and not torch.compiler.is_compiling() else None


def note(name: str, reason: str, skipped: float = 0.0, *, exact: bool = True) -> None:
    """Report a :class:`Stage`; the last word on each counts."""
    if (found := journal()) is not None:
        found.note(name, reason, skipped, exact=exact)


def ask(values: Tensor, tell: Tell) -> None:
    """Have numbers told that a device computes: at once where they are at hand, else when the journal is settled.

    Args:
        values: any number of them, of any shape.
        tell: takes them as they lie in memory; may raise. Of values that are not at hand, nothing is told where nobody
            listens.
    """
    if at_hand(values.device):
        tell(values.detach().reshape(-1).tolist())
    elif (found := journal()) is not None:
        found.ask(values, tell)


def tell_history(fraction: Tensor) -> None:
    """Report which fraction of the pixels found themselves in the frame before, a tensor of one number."""
    if (found := journal()) is None:
        return

    def tell(fraction: Sequence[float]) -> None:
        (found.history,) = fraction

    ask(fraction, tell)


def timed(stage: str, device: torch.device, *, unless_told: bool = False) -> AbstractContextManager[None]:
    """Measure the run time of a stage; what is timed within it counts as its own stage and not as this one.

    Args:
        stage: its name.
        device: where it runs. A GPU is not waited for: it marks the time itself, which is read when the journal is
            settled.
        unless_told: whether the stage counts only if nothing is timed within it.
    """
    found = journal()
    return nullcontext() if found is None else found.timed(stage, device, unless_told=unless_told)


def summarize(frames: list[list[Stage]]) -> list[dict[str, Any]]:
    """What was skipped in a shot.

    Args:
        frames: the stages of each frame.

    Returns:
        For each stage, in order: ``stage``; ``kept``, false if all of it was skipped in all frames; ``skipped``, the
        mean fraction, from 0 to 1; ``reason``, the most frequent one for skipping it, or else for keeping it; and
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
