"""What happened while a frame was denoised: run times, and what was skipped and why.

Methods are pure; what they report goes beside their results to whoever listens, and to nobody otherwise.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any

import torch


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
class Journal:
    """What is reported of one frame.

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


_listening: list[Journal] = []


@contextmanager
def listening(journal: Journal) -> Iterator[None]:
    """Collect in a journal what methods report."""
    _listening.append(journal)
    try:
        yield
    finally:
        _listening.pop()


def journal() -> Journal | None:
    """The journal of whoever listens."""
    return _listening[-1] if _listening and not torch.compiler.is_compiling() else None


def note(name: str, reason: str, skipped: float = 0.0, *, exact: bool = True) -> None:
    """Report a :class:`Stage`; the last word on each counts."""
    if (found := journal()) is not None:
        found.stages[name] = Stage(name, float(skipped), reason, exact)


def timed(stage: str, device: torch.device) -> AbstractContextManager[None]:
    """Measure the run time of a stage; what is timed within it counts as its own stage and not as this one."""
    found = journal()
    return nullcontext() if found is None else _timed(found, stage, device)


@contextmanager
def _timed(found: Journal, stage: str, device: torch.device) -> Iterator[None]:
    start, within = clock(device), sum(found.milliseconds.values())
    yield
    taken = clock(device) - start - (sum(found.milliseconds.values()) - within)
    found.milliseconds[stage] = found.milliseconds.get(stage, 0.0) + taken


def clock(device: torch.device) -> float:
    """Milliseconds, after the device has finished."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter() * 1e3


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
