"""Denoise a folder of frames: clean EXRs, and a report of what was done and how long each stage took."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from mcdenoise.buffers import Frame
from mcdenoise.data import Sequence, write_exr
from mcdenoise.data.files import write_text
from mcdenoise.denoiser import Denoiser, FrameReport, Images
from mcdenoise.errors import InputError
from mcdenoise.plan import Stage, summarize


@dataclass
class SequenceReport:
    """What was done to a sequence.

    Args:
        model: name of the model or path of its weights.
        reading: how the sequence stores its color.
        frames: what happened to each frame, by number; its run times include reading and writing.
    """

    model: str
    reading: str
    frames: dict[int, FrameReport] = field(default_factory=dict)

    @property
    def milliseconds(self) -> dict[str, float]:
        """Median run time of each stage over the frames after the first, which pays for warming up."""
        reports = list(self.frames.values())
        reports = reports[1:] or reports
        return {
            stage: sorted(report.milliseconds[stage] for report in reports)[len(reports) // 2]
            for stage in reports[0].milliseconds
        }

    @property
    def plan(self) -> list[dict[str, Any]]:
        """For each stage whether it was kept, how much of it was left out, and why, see :func:`summarize`."""
        read = Stage("read", 0.0, self.reading)
        return summarize([[read, *report.stages] for report in self.frames.values()])

    @property
    def replaced_pixels(self) -> int:
        """Pixels of the noisy color, over all frames, that were NaN, infinite or negative."""
        return sum(report.replaced_pixels for report in self.frames.values())


def denoise_sequence(
    sequence: Sequence,
    out: Path,
    denoiser: Denoiser,
    model: str,
    *,
    half: bool = True,
    references: bool = False,
    on_frame: Callable[[Frame, Images], None] = lambda frame, images: None,
) -> SequenceReport:
    """Denoise a sequence and write ``OUT/denoisedN.exr`` and ``OUT/denoise.json``.

    Args:
        sequence: the frames.
        out: folder to write to; made if it does not exist.
        denoiser: is reset first.
        model: what to call the model in the report.
        half: write half floats, else 32-bit floats.
        references: read references too, for ``on_frame``.
        on_frame: called with each finished frame and its images.

    Raises:
        InputError: a file is damaged, a buffer has invalid values, or the folder cannot be written to.
    """
    make_folder(out)
    # A report stands for a complete result: an old one must not survive a run that fails half-way.
    (out / "denoise.json").unlink(missing_ok=True)
    stored = "with albedo" if sequence.color_has_albedo else "without albedo, which the reader multiplies back"
    report = SequenceReport(model, f"color is stored {stored}")
    for number, (frame, images) in zip(
        sequence.numbers, denoised_frames(sequence, denoiser, reference=references), strict=True
    ):
        start = time.perf_counter()
        pixels = images.denoised[0].permute(1, 2, 0).cpu().numpy()
        write_exr(out / f"denoised{number}.exr", pixels, ["R", "G", "B"], half=half, metadata=sequence.metadata(number))
        report.frames[number] = denoiser.report
        denoiser.report.milliseconds["write"] = (time.perf_counter() - start) * 1e3
        on_frame(frame, images)
    write_text(out / "denoise.json", json.dumps(_as_json(sequence, denoiser, report), indent=2) + "\n")
    return report


def denoised_frames(
    sequence: Sequence, denoiser: Denoiser, *, reference: bool = True
) -> Iterator[tuple[Frame, Images]]:
    """Read and denoise frame after frame.

    Args:
        sequence: the frames.
        denoiser: is reset first.
        reference: read references too.

    Yields:
        Each frame with its images; the denoiser's report includes the time to read.

    Raises:
        InputError: a file is damaged, or a buffer has invalid values; the message names the frame.
    """
    denoiser.reset(sequence.buffers, len(sequence))
    for number in sequence.numbers:
        start = time.perf_counter()
        frame = sequence.frame(number, reference=reference)
        read = (time.perf_counter() - start) * 1e3
        try:
            images = denoiser.images(frame)
        except InputError as error:
            raise InputError(f"{sequence.root}, frame {number}: {error}") from error
        denoiser.report.milliseconds = {"read": read, **denoiser.report.milliseconds}
        yield frame, images


def make_folder(out: Path) -> None:
    """Make a folder to write results to; ``InputError`` where that cannot be."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: expected a folder that can be written to, found: {error.strerror}") from error


def _as_json(sequence: Sequence, denoiser: Denoiser, report: SequenceReport) -> dict[str, Any]:
    return {
        "model": report.model,
        "versions": {name: version(name) for name in ("mcdenoise", "torch", "kornia")},
        "device": str(denoiser.device),
        "precision": denoiser.precision,
        "threads": torch.get_num_threads(),
        "sequence": {"name": sequence.name, "layout": sequence.layout, "size": list(sequence.size)},
        "keep_all": denoiser.plan.keep_all,
        "tolerance": denoiser.plan.tolerance,
        "plan": report.plan,
        "milliseconds": report.milliseconds,
        "frames": {
            str(number): {
                "milliseconds": done.milliseconds,
                "reset": done.reset,
                "replaced_pixels": done.replaced_pixels,
                "missing": done.missing,
            }
            for number, done in report.frames.items()
        },
    }
