"""The report of denoising a sequence: skipped work, run times, and probable mistakes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcdenoise.models._report import FrameReport, Stage, summarize


@dataclass
class SequenceReport:
    """Report of denoising a sequence.

    Args:
        model: name of the model with its settings, or path of its weights.
        with_albedo: whether the sequence stores its color with the albedo.
        picked: the model that limits of run time or error have picked, and why; empty without limits.
        frames: report of each frame, by number; run times include waiting for the disk.
        files: the written file of each frame, by number.
        alike: frames that look like the previous one but have no history.
        older: names of files of other frames that existed before and still exist.
    """

    model: str
    with_albedo: bool
    picked: str = ""
    frames: dict[int, FrameReport] = field(default_factory=dict)
    files: dict[int, Path] = field(default_factory=dict)
    alike: list[int] = field(default_factory=list)
    older: list[str] = field(default_factory=list)

    @property
    def milliseconds(self) -> dict[str, float]:
        """Median run time of each stage over all frames but the first, which includes warming up."""
        return _medians([report.milliseconds for report in self.frames.values()])

    @property
    def beside(self) -> dict[str, float]:
        """Median run times of reading and writing, which overlap with denoising another frame."""
        return _medians([report.beside for report in self.frames.values()])

    @property
    def tiles(self) -> str:
        """How the image was divided into tiles for the network, and why."""
        return next((report.tiles for report in self.frames.values()), "")

    @property
    def precision(self) -> str:
        """The reason for the precision of the convolutions."""
        return next((report.precision for report in self.frames.values()), "")

    @property
    def plan(self) -> list[dict[str, Any]]:
        """For each stage, whether it was computed, how much of it was skipped, and why, see :func:`summarize`."""
        stored = "with albedo" if self.with_albedo else "without albedo, which the reader multiplies back"
        read = Stage("read", 0.0, f"color is stored {stored}")
        return summarize([[read, *report.stages.values()] for report in self.frames.values()])

    @property
    def warnings(self) -> list[str]:
        """Probable mistakes in the input or output."""
        found = []
        # A shot may contain cuts, but not at every second frame.
        if len(self.alike) * 4 > len(self.frames):
            found.append(
                f"history: in {len(self.alike)} of {len(self.frames)} frames most pixels find nothing in the frame "
                "before, though the two look alike; check motion and cameras with `mcdenoise inspect`"
            )
        if doubts := [(number, done.repairs.doubt) for number, done in self.frames.items() if done.repairs.doubt]:
            number, doubt = doubts[0]
            found.append(f"{doubt} (frame {number}, and {len(doubts) - 1} others of {len(self.frames)})")
        if repeated := [(number, done.repeats) for number, done in self.frames.items() if done.repeats]:
            number, advice = repeated[0]
            found.append(f"{advice} (frame {number}, and {len(repeated) - 1} others of {len(self.frames)})")
        # These files may be other frames of the same shot and hours of work: only the user may remove them.
        if self.older:
            names = ", ".join(self.older if len(self.older) <= 4 else [self.older[0], "...", self.older[-1]])
            found.append(
                f"output: {len(self.older)} {'file' if len(self.older) == 1 else 'files'} of an earlier run ({names}) "
                "remain beside the result, and denoise.json does not list them; remove what is not wanted"
            )
        return found

    @property
    def replaced_pixels(self) -> int:
        """Pixels of the noisy color, over all frames, that were NaN, infinite, negative or above 1e16."""
        return sum(report.replaced_pixels for report in self.frames.values())


def _medians(frames: list[dict[str, float]]) -> dict[str, float]:
    frames = frames[1:] or frames
    # A model may skip a stage in some frames.
    stages = dict.fromkeys(stage for times in frames for stage in times)
    return {stage: sorted(times.get(stage, 0.0) for times in frames)[len(frames) // 2] for stage in stages}
