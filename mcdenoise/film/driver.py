"""The driver: hands the tasks of a film to an engine, and says what came of them."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.metadata import version
from itertools import groupby
from pathlib import Path
from typing import Any

import msgspec

from mcdenoise.data.files import held, make_folder, sweep, write_json, write_text
from mcdenoise.engines import Engine, RayEngine, Task, run_tasks
from mcdenoise.errors import naming
from mcdenoise.film import work
from mcdenoise.film.manifest import RECORDS, Shot
from mcdenoise.report import render_page
from mcdenoise.results import Results

_CHANGED = "its files changed while the film was made; run the same command again"


@dataclass
class ShotResult:
    """The state of a shot.

    Args:
        shot: the shot; with the model that limits have picked, once it was looked at.
        found: what the last look has found; ``None`` before the first one.
        missing: numbers of the frames that were not finished before this run.
        made: number of frames that were denoised in this run.
        failed: for each failed frame, by number, the reason.
        reason: why the whole shot failed; ``None`` if it did not.
    """

    shot: Shot
    found: work.Found | None = None
    missing: frozenset[int] = frozenset()
    made: int = 0
    failed: dict[int, str] = field(default_factory=dict)
    reason: str | None = None

    @property
    def complete(self) -> bool:
        """Whether every frame is finished."""
        return not self.reason and self.found is not None and not self.found.missing and not self.found.unreadable

    def failures(self) -> list[tuple[str, str]]:
        """The failed frames and the reasons; neighbours with the same reason are one row."""
        rows = [("all", self.reason)] if self.reason else []
        for why, group in groupby(sorted(self.failed.items()), lambda each: each[1]):
            numbers = [number for number, _ in group]
            several = f"{numbers[0]} to {numbers[-1]} ({len(numbers)})"
            rows.append((several if len(numbers) > 1 else f"{numbers[0]}", why))
        return rows

    def as_json(self) -> dict[str, Any]:
        """What ``film.json`` and the page say of the shot; its ``denoise.json`` says more of its frames."""
        about: dict[str, Any] = msgspec.to_builtins(self.shot, enc_hook=str)
        about |= {"complete": self.complete, "made": self.made}
        for name in ("numbers", "pictures", "warnings"):
            about[name] = list(getattr(self.found, name, ()))
        return about | {"failed": [{"frames": frames, "why": why} for frames, why in self.failures()]}


def run_film(
    shots: Sequence[Shot],
    out: Path,
    engine: Engine,
    *,
    piece: int = 200,
    on_progress: Callable[[int, int | None], None] = lambda made, total: None,
    on_shot: Callable[[ShotResult], None] = lambda result: None,
) -> list[ShotResult]:
    """Denoise a film: look at every shot, denoise the frames that are not finished, and look again.

    A frame, a piece or a shot that fails is named in the result, and all others go on. The same call again resumes the
    film, however the last one ended. ``OUT/film.json`` is written at the start, and at the end, also after an error.

    Args:
        shots: in the order in which they are started.
        out: output folder; each shot gets a folder of its name in it.
        engine: runs the tasks, and is closed at the end.
        piece: largest number of frames in a piece; 0 does not cut shots.
        on_progress: called with the number of frames that were denoised, and of those that this run has to denoise;
            the latter is ``None`` until all shots were looked at.
        on_shot: called with each shot that is finished, or has failed.

    Returns:
        The state of each shot.

    Raises:
        InputError: a model cannot be built with the settings of its shot, the folder cannot be written to, or another
            process writes a film to it.
    """
    out = Path(os.path.abspath(out))
    results, tasks, due = [ShotResult(each) for each in shots], deque[Task](), 0.0

    def count() -> None:
        nonlocal due
        if (start := time.monotonic()) >= due:
            made = sum(_count(each, out) for each in results)
            known = all(each.found or each.reason for each in results)
            on_progress(made, sum(len(each.missing) for each in results) if known else None)
            # Many folders take long to read.
            due = start + max(0.5, 20 * (time.monotonic() - start))

    try:
        _check(shots, device="cpu" if isinstance(engine, RayEngine) else "")
        make_folder(out / RECORDS)
        with held(out / RECORDS, "film"):
            tasks.extend(_shot(each, out, piece, tasks, on_shot) for each in results)
            write_json(out / "film.json", _as_json(results))
            try:
                run_tasks(engine, tasks, count)
            finally:
                # No worker is alive any more: what is half-written belongs to those that were killed.
                for each in results:
                    _count(each, out)
                    sweep(out / each.shot.name, youngest=0)
                    sweep(out / RECORDS / each.shot.name, youngest=0)
                write_json(out / "film.json", _as_json(results))
    finally:
        engine.close()
    return results


def _as_json(results: Iterable[ShotResult]) -> dict[str, Any]:
    complete = all(each.complete for each in results)
    return {"version": version("mcdenoise"), "complete": complete, "shots": [each.as_json() for each in results]}


def write_page(results: Iterable[ShotResult], out: Path) -> Path:
    """Write ``OUT/film.html``: what ``film.json`` says, with thumbnails, which are files beside it.

    Shots that are not complete come first.

    Args:
        results: of :func:`run_film`.
        out: the folder of the film.

    Returns:
        The path of the page.

    Raises:
        InputError: a package of ``mcdenoise[report]`` is not installed, or the page cannot be written.
    """
    about = _as_json(sorted(results, key=lambda each: each.complete))
    write_text(out / "film.html", render_page("film.html.jinja", about))
    return out / "film.html"


def _check(shots: Iterable[Shot], device: str) -> None:
    """Build each model once, on a device or that of its shot, so that a misspelt one is found before all work."""
    # To measure which precision is fast takes time.
    changes: dict[str, Any] = {"frames": None, "precision": "float32"} | ({"device": device} if device else {})
    for settings, shot in {replace(each.settings, **changes): each for each in shots}.items():
        with naming(f"shot '{shot.name}'"):
            settings.denoiser()
            if settings.results is not None:
                Results.read(settings.results)


def _count(result: ShotResult, out: Path) -> int:
    """Count the frames of a shot that this run has finished: the first look has left no records of them."""
    if result.missing:
        there = {path.stem for path in (out / RECORDS / result.shot.name).glob("*.json")}
        result.made = sum(f"{number}" in there for number in result.missing)
    return result.made


def _shot(
    result: ShotResult, out: Path, length: int, tasks: deque[Task], on_shot: Callable[[ShotResult], None]
) -> Task:
    """The first task of a shot; at its end it adds those that denoise the pieces, and the last of them another look."""
    left: list[work.Piece] = []

    def looked(again: bool, found: work.Found | None, reason: str | None) -> None:
        result.reason = reason
        if found is not None:
            result.found, result.shot = found, found.shot
            result.missing = result.missing or found.missing
            left.extend([] if again else found.pieces(length))
            tasks.extend(Task(work.make, (found.shot, out, each), partial(made, each)) for each in left)
            # Frames of a lost piece may be finished.
            failed = {number: result.failed.get(number, _CHANGED) for number in found.missing if again}
            result.failed = found.unreadable | failed
        if not left:
            _count(result, out)
            on_shot(result)

    def made(piece: work.Piece, failed: dict[int, str] | None, reason: str | None) -> None:
        result.failed |= dict.fromkeys(piece[1], f"{reason}") if failed is None else failed
        left.remove(piece)
        if not left:
            tasks.appendleft(Task(work.look, (result.shot, out), partial(looked, True)))

    return Task(work.look, (result.shot, out), partial(looked, False))
