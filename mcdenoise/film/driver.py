"""The driver: hands the tasks of a film to an engine, and says what came of them."""

from __future__ import annotations

import os
import secrets
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from mcdenoise.data.files import held, make_folder, sweep, write_json
from mcdenoise.engines import Engine, Job, RayEngine, Task, run_jobs
from mcdenoise.errors import InputError
from mcdenoise.film import work
from mcdenoise.film.manifest import Shot
from mcdenoise.film.pieces import cut
from mcdenoise.film.work import RECORDS, Found, Order, Summary
from mcdenoise.results import Results

FILE = "film.json"
# All shots are scanned first, so that wrong input is reported early and the time left is known.
_SCAN, _SUMMARIZE, _MAKE = range(3)
# Seconds between readings of the journals, at least, and as a multiple of what one takes.
_PAUSE, _PAUSES = 0.5, 20


@dataclass(frozen=True)
class Film:
    """A film to be denoised.

    Args:
        shots: in the order in which they are started.
        out: output folder; each shot gets a folder of its name in it.
        piece: largest number of frames in a piece; 0 does not cut shots.
        joint: largest difference of a frame from that of the uncut shot, as a fraction; it decides how many frames
            before its first a piece begins.
        threads: of torch in each worker; ``None`` for its own choice.
    """

    shots: Sequence[Shot]
    out: Path
    piece: int = 200
    joint: float = 1e-2
    threads: int | None = None


@dataclass
class ShotResult:
    """The state of a shot.

    Args:
        shot: the shot; with the model that limits have picked, after the scan.
        found: result of the scan; ``None`` before it.
        made: number of frames that were denoised in this run.
        failed: for each failed frame, by number, the reason.
        reason: why the whole shot failed; ``None`` if it did not.
        summary: of the finished frames; ``None`` before the last task of the shot.
        repeated: number of frames that were denoised again because their files had changed meanwhile.
    """

    shot: Shot
    found: Found | None = None
    made: int = 0
    failed: dict[int, str] = field(default_factory=dict)
    reason: str | None = None
    summary: Summary | None = None
    repeated: int = 0

    @property
    def complete(self) -> bool:
        """Whether every frame is finished."""
        return self.summary is not None and not self.failed and not self.reason

    @property
    def to_make(self) -> int | None:
        """Number of frames that this run has to denoise; ``None`` before the scan."""
        return None if self.found is None else len(self.found.numbers) - len(self.found.done) + self.repeated

    def failures(self) -> list[tuple[str, str]]:
        """The failed frames and the reasons; neighbours with the same reason are one row."""
        rows: list[tuple[list[int], str]] = []
        for number, why in sorted(self.failed.items()):
            if rows and rows[-1][1] == why:
                rows[-1][0].append(number)
            else:
                rows.append(([number], why))
        named = [(f"{n[0]}" if len(n) == 1 else f"{n[0]} to {n[-1]} ({len(n)})", why) for n, why in rows]
        return [("all", self.reason), *named] if self.reason else named

    def as_json(self) -> dict[str, Any]:
        """What ``film.json`` and the page say of the shot."""
        shot, found, summary = self.shot, self.found, self.summary or Summary()
        settings = {key: value for key, value in asdict(shot.settings).items() if value not in (None, (), False)}
        return {
            "name": shot.name,
            "input": [str(path) for path in shot.inputs],
            "settings": {key: str(value) if isinstance(value, Path) else value for key, value in settings.items()},
            "complete": self.complete,
            "made": self.made,
            "failed": [{"frames": frames, "why": why} for frames, why in self.failures()],
            "frames": list(found.numbers) if found is not None else [],
            "found_finished": len(found.done) if found is not None else 0,
            "overlap": found.overlap if found is not None else None,
            "picked": shot.picked,
            "milliseconds": summary.milliseconds,
            "worst": [row["number"] for row in summary.worst],
            "resets": {str(row["number"]): row["reset"] for row in summary.frames if row["reset"]},
            "warnings": list(summary.warnings),
        }


@dataclass
class FilmResult:
    """How a film ended.

    Args:
        shots: in the order of the film.
        seconds: run time.
        trouble: why ``film.json`` could not be written; empty if it was.
    """

    shots: list[ShotResult]
    seconds: float = 0.0
    trouble: str = ""

    @property
    def complete(self) -> bool:
        """Whether every frame of every shot is finished."""
        return not self.trouble and all(each.complete for each in self.shots)

    @property
    def made(self) -> int:
        """Number of frames that were denoised in this run."""
        return sum(each.made for each in self.shots)


def run_film(
    film: Film,
    engine: Engine,
    *,
    on_progress: Callable[[int, int | None], None] = lambda made, total: None,
    on_shot: Callable[[ShotResult], None] = lambda result: None,
) -> FilmResult:
    """Denoise a film: scan every shot, denoise the frames that are not finished, and summarize each shot.

    A frame, a piece or a shot that fails is named in the result, and all others go on. The same call again resumes the
    film, however the last one ended. ``OUT/film.json`` is written at the end, also after an error or an interruption.

    Args:
        film: the film.
        engine: runs the tasks, and is closed at the end.
        on_progress: called with the number of frames that were denoised, and of those that this run has to denoise;
            the latter is ``None`` until all shots are scanned.
        on_shot: called with each shot that is summarized, or has failed.

    Raises:
        InputError: a model cannot be built with the settings of its shot, the folder cannot be written to, or another
            process writes a film to it. No frame is made then.
    """
    try:
        _check(film, device="cpu" if isinstance(engine, RayEngine) else "")
        make_folder(film.out / RECORDS)
        with held(film.out / RECORDS, "film"):
            return _run(film, engine, on_progress, on_shot)
    finally:
        engine.close()


def _check(film: Film, device: str) -> None:
    """Build each model once: a misspelt one would otherwise be found after other shots are denoised.

    Args:
        film: the film.
        device: to build them on; that of the shot by default.
    """
    checked = set()
    for shot in film.shots:
        settings = replace(shot.settings, frames=None, device=device or shot.settings.device)
        # To measure which precision is fast takes time.
        settings = replace(settings, precision="float32")
        if settings not in checked:
            checked.add(settings)
            try:
                settings.denoiser()
                if settings.results is not None:
                    Results.read(settings.results)
            except InputError as error:
                raise InputError(f"shot '{shot.name}': {error}") from error


def _run(
    film: Film,
    engine: Engine,
    on_progress: Callable[[int, int | None], None],
    on_shot: Callable[[ShotResult], None],
) -> FilmResult:
    began, created = time.monotonic(), datetime.now(UTC).isoformat(timespec="seconds")
    run, out = f"{secrets.token_hex(8)}-", Path(os.path.abspath(film.out))
    orders = [Order(each, out, film.joint, film.threads, run) for each in film.shots]
    result = FilmResult([ShotResult(each) for each in film.shots])
    pause, counted = _PAUSE, began

    def count() -> None:
        nonlocal pause, counted
        if (start := time.monotonic()) - counted >= pause:
            for each, order in zip(result.shots, orders, strict=True):
                each.made = order.made()
            counted = time.monotonic()
            pause = max(_PAUSE, _PAUSES * (counted - start))
            totals = [each.to_make for each in result.shots if not each.reason]
            on_progress(result.made, None if None in totals else sum(filter(None, totals)))

    try:
        made = zip(orders, result.shots, strict=True)
        run_jobs(engine, [_shot(film, *each, on_shot) for each in made], count)
    finally:
        # No worker is alive any more: what is half-written belongs to those that were killed.
        for order, each in zip(orders, result.shots, strict=True):
            each.made = order.made()
            for folder in (order.folder, order.records):
                sweep(folder, youngest=0)
        result.seconds = time.monotonic() - began
        try:
            about = {"created": created, "version": version("mcdenoise"), "complete": result.complete}
            about |= {"seconds": round(result.seconds, 3), "frames_made": result.made, "piece": film.piece}
            about |= {"joint_tolerance": film.joint, "shots": [each.as_json() for each in result.shots]}
            write_json(film.out / FILE, about)
        except InputError as error:
            result.trouble = str(error)
    return result


def _shot(film: Film, order: Order, result: ShotResult, on_shot: Callable[[ShotResult], None]) -> Job:
    """The tasks of a shot: scan it, make what is missing, summarize it; once more for files that changed meanwhile."""
    [(found, result.reason)] = yield [Task(work.scan, (order,), _SCAN)]
    if found is None:
        on_shot(result)
        return
    result.found, result.shot = found, found.shot
    result.failed.update(found.unreadable)
    order = replace(order, shot=found.shot)
    missing = set(found.numbers) - found.done
    for again in (False, True):
        pieces = cut(found.numbers, missing, film.piece, found.overlap)
        outcomes = yield [Task(work.make, (order, each), _MAKE, order.made) for each in pieces]
        for piece, (failures, reason) in zip(pieces, outcomes, strict=True):
            result.failed.update(dict.fromkeys(piece.wanted, str(reason)) if failures is None else failures)
        [(summary, result.reason)] = yield [Task(work.summarize, (order,), _SUMMARIZE)]
        if summary is None:
            break
        # Frames of a lost piece may be finished.
        kept = summary.unfinished | found.unreadable.keys()
        result.failed = {number: why for number, why in result.failed.items() if number in kept}
        missing = set(summary.unfinished) - result.failed.keys()
        if again or not missing:
            reason = "its files changed while the film was made, and once more; run the same command when they stay"
            result.failed.update(dict.fromkeys(missing, reason))
            result.summary = summary
            break
        result.repeated = len(missing)
    result.made = order.made()
    on_shot(result)
