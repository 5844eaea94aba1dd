"""The report of a frame: what was skipped and why, and figures, from the notes of its steps.

Making a report never makes the host wait for a GPU: values are copied asynchronously when the frame is done, and read
when the report is read or when the next frame begins.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from mcdenoise.light import Repairs
from mcdenoise.models._interface import Note, Tell, at_hand
from mcdenoise.models._times import Moment, Stopwatch


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
class FrameReport:
    """The report of one frame. For a frame on a GPU it is complete after :meth:`settle`.

    Args:
        milliseconds: run time of each stage; under the model's name what it spends outside of its stages.
        stages: how much of each stage was skipped, and why, by name.
        reset: why the history was discarded; empty if it was used.
        tiles: how the image was divided into tiles, and why.
        history: fraction of the pixels that have a history; ``None`` if no history was looked up.
        precision: the reason for the precision of the convolutions.
        repairs: what was NaN, infinite, negative or above 1e16 in the noisy color.
        repeats: the advice for frames that repeat the noise of the frame before; empty for others.
        missing: buffers that would improve the result and that the frame lacks.
        beside: milliseconds of work that overlaps with denoising another frame: read, write.
    """

    milliseconds: dict[str, float] = field(default_factory=dict)
    stages: dict[str, Stage] = field(default_factory=dict)
    reset: str = ""
    tiles: str = ""
    history: float | None = None
    precision: str = ""
    repairs: Repairs = field(default_factory=Repairs)
    repeats: str = ""
    missing: list[str] = field(default_factory=list)
    beside: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # These are no dataclass fields, because a written report must not contain them.
        self._asked: list[tuple[Tensor, Tell]] = []
        self._sent: tuple[Tensor, Stopwatch, Moment] | None = None

    @property
    def replaced_pixels(self) -> int:
        """Number of pixels of the noisy color that were NaN, infinite, negative or above 1e16."""
        return self.repairs.pixels

    def __str__(self) -> str:
        """A few lines: run times, the history, and what was skipped, missing or replaced."""
        stages = ", ".join(f"{stage} {value:.1f}" for stage, value in self.milliseconds.items())
        history = "" if self.history is None else f"{self.history:.0%} of the pixels"
        skipped = (
            f"{stage.name}{'' if stage.skipped == 1 else f' {stage.skipped:.1%}'} ({stage.reason})"
            for stage in self.stages.values()
            if stage.skipped
        )
        lines = {
            "milliseconds": f"{stages}; together {sum(self.milliseconds.values()):.1f}" if stages else "",
            "history": f"none ({self.reset})" if self.reset else history,
            "skipped": ", ".join(skipped),
            "missing": ", ".join(self.missing),
            "replaced pixels": str(self.replaced_pixels or ""),
            "negative light": f"{self.repairs.negative:.2%}" if self.repairs.negative else "",
            "tiles": self.tiles,
            "precision": self.precision,
        }
        return "\n".join(f"{name}: {text}" for name, text in lines.items() if text)

    def add(self, notes: Iterable[Note]) -> None:
        """Add what steps tell; a later note replaces an earlier one of the same name."""
        for note in notes:
            figures = [each.detach().double().reshape(-1) for each in note[2:4] if isinstance(each, Tensor)]
            if not figures:
                self._write(note, float(note.skipped), note.value)
                continue
            if note.name != "history":
                # Stages are in the order of the notes, also where their figures come later.
                self._write(note, 0.0, None)

            def tell(numbers: Sequence[float], note: Note = note) -> None:
                known = iter(numbers)
                skipped = next(known) if isinstance(note.skipped, Tensor) else note.skipped
                self._write(note, skipped, max(known) if isinstance(note.value, Tensor) else note.value)

            self.ask(torch.cat(figures), tell)

    def _write(self, note: Note, skipped: float, value: Any) -> None:
        reason = note.reason if skipped or note.otherwise is None else note.otherwise
        if note.name == "history":
            self.reset, self.history = reason, self.history if value is None else value
        else:
            self.stages[note.name] = Stage(note.name, skipped, reason, note.exact)

    def ask(self, values: Tensor, tell: Tell) -> None:
        """Handle values that a device computes: at once if the host can read them, else in :meth:`settle`.

        Args:
            values: any number of them, of any shape.
            tell: handles the values in memory order; may raise.
        """
        if at_hand(values.device):
            tell(values.detach().reshape(-1).tolist())
        else:
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
