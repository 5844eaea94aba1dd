"""The last task of a shot: its report, its preview, and what the page shows of it."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch.nn.functional as F

from mcdenoise.data.files import sweep
from mcdenoise.data.readers.opening import open_result
from mcdenoise.errors import InputError
from mcdenoise.film.manifest import PICTURES
from mcdenoise.film.record import FrameRecord
from mcdenoise.film.work import Keys, Opened, Order, open_order
from mcdenoise.folder import new_report, write_report
from mcdenoise.preview import Preview

# Largest side of a thumbnail; thumbnails in the strip, and of the worst frames.
_THUMBNAIL, _STRIP, _WORST = 320, 6, 3


@dataclass(frozen=True)
class Summary:
    """The summary of a shot.

    Args:
        milliseconds: median run time of each stage.
        frames: for each frame ``number``, ``change``, ``history``, ``reset``, ``replaced_pixels`` and ``score``.
        worst: the rows with the highest scores, and ``picture``, the path of a thumbnail relative to the page.
        strip: number and thumbnail of some other frames across the shot.
        warnings: what is probably wrong, a line each.
        unfinished: the numbers of all other frames: those that failed, and those whose files have changed meanwhile.
    """

    milliseconds: Mapping[str, float] = field(default_factory=dict)
    frames: tuple[Mapping[str, Any], ...] = ()
    worst: tuple[Mapping[str, Any], ...] = ()
    strip: tuple[tuple[int, str], ...] = ()
    warnings: tuple[str, ...] = ()
    unfinished: frozenset[int] = frozenset()


def summarize(order: Order) -> Summary:
    """A task: write ``denoise.json`` of a complete shot, its thumbnails and its preview.

    Raises:
        InputError: as :func:`scan`, or something cannot be written.
    """
    opened = open_order(order)
    found = Keys(opened).finished(order, opened.sequence.numbers)
    records = list(found.values())
    spelling = opened.shot.settings.spelling
    report = new_report(opened.sequence, str(spelling.weights or spelling.name), opened.shot.picked)
    report.frames = {each.number: each.report for each in records}
    report.files = {each.number: order.result(each) for each in records}
    report.alike = [each.number for each in records if each.alike]
    for folder in (order.folder, order.records):
        sweep(folder, youngest=0)
    unfinished = frozenset(opened.sequence.numbers) - found.keys()
    if not unfinished and not opened.unreadable:
        write_report(opened.sequence, order.folder, opened.denoiser, report)
        if opened.shot.settings.preview:
            _preview(order, opened, report.files)
    warnings = list(opened.sequence.warnings)
    if not records:
        return Summary(warnings=tuple(warnings), unfinished=unfinished)
    rows = _described(records)
    worst = sorted(rows, key=lambda row: (-row["score"], row["number"]))[:_WORST]
    steps = np.linspace(0, len(records) - 1, min(_STRIP, len(records))).round().astype(int)
    numbers = dict.fromkeys([row["number"] for row in worst] + [records[step].number for step in steps])
    pictures = _pictures(order, [found[number] for number in numbers])
    worst = [{**row, "picture": pictures.pop(row["number"])} for row in worst if row["number"] in pictures]
    warnings += report.warnings
    strip = tuple(sorted(pictures.items()))
    return Summary(report.milliseconds, tuple(rows), tuple(worst), strip, tuple(warnings), unfinished)


def _described(records: Collection[FrameRecord]) -> list[dict[str, Any]]:
    """Rows of the page, a frame each; ``score`` is the smaller one of its changes from both neighbours."""
    rows: list[dict[str, Any]] = []
    changes = {each.number: each.change for each in records}
    for each in records:
        sides = [c for c in (changes.get(each.number), changes.get(each.number + 1)) if c is not None]
        rows.append(
            {
                "number": each.number,
                "change": each.change,
                "history": each.report.history,
                "reset": each.report.reset,
                "replaced_pixels": each.report.replaced_pixels,
                "milliseconds": sum(each.report.milliseconds.values()),
                "score": min(sides, default=0.0),
            }
        )
    return rows


def _pictures(order: Order, records: list[FrameRecord]) -> dict[int, str]:
    """Write thumbnails of frames; their paths, by number of the frame."""
    shown = Preview(order.out / PICTURES / order.shot.name, video=False)
    found = {}
    for record in records:
        try:
            image, metadata = open_result(order.result(record)).read()
        except InputError:
            continue
        height, width = image.shape[-2:]
        scale = min(1.0, _THUMBNAIL / max(height, width))
        image = F.interpolate(image, (max(1, round(height * scale)), max(1, round(width * scale))), mode="area")
        shown.add(f"{record.number}", image, metadata)
        found[record.number] = os.path.relpath(shown.written[-1], order.out)
    return found


def _preview(order: Order, opened: Opened, files: Mapping[int, Path]) -> None:
    """Write the preview of `mcdenoise denoise --preview` from the files, whose frames were denoised in any order."""
    shown = opened.shot.settings.preview_in(order.folder, video=len(files) > 1)
    for path in files.values():
        image, metadata = open_result(path).read(opened.sequence.window)
        shown.add(path.stem, image, metadata)
    shown.close()
