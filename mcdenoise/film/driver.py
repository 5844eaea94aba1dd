"""The driver: schedules the tasks of a film, counts finished frames, and retries tasks whose workers are lost."""

from __future__ import annotations

import os
import secrets
import time
from collections import deque
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from mcdenoise.data.files import held, sweep, write_json
from mcdenoise.engines import MOST_LOSSES, Done, Engine, RayEngine, describe_error
from mcdenoise.errors import InputError
from mcdenoise.film import work
from mcdenoise.film.manifest import Shot
from mcdenoise.film.pieces import Piece, cut
from mcdenoise.film.record import Tail, read_journal
from mcdenoise.film.work import RECORDS, Found, Made, Order, Summary
from mcdenoise.folder import make_folder
from mcdenoise.results import Results

_SECONDS_BETWEEN_POLLS = 0.2
# Seconds between reading all journals: a thousand of them cost no more than some hundred reads a second.
_SECONDS_BETWEEN_COUNTS, _SECONDS_A_JOURNAL = 0.5, 0.002
FILE = "film.json"


@dataclass(frozen=True)
class Film:
    """A film to be denoised.

    Args:
        shots: in the order in which they are started.
        out: output folder; each shot gets a folder of its name in it.
        piece: largest number of frames in a piece; 0 does not cut shots.
        joint: largest difference of a frame from that of the uncut shot, as a fraction.
        threads: of torch in each worker; ``None`` for its own choice.
    """

    shots: Sequence[Shot]
    out: Path
    piece: int = 200
    joint: float = 1e-2
    threads: int | None = None

    def order(self, shot: Shot) -> Order:
        """The order that every task of a shot gets."""
        return Order(shot, Path(os.path.abspath(self.out)), self.joint, self.threads)


@dataclass
class ShotResult:
    """The state of a shot.

    Args:
        shot: the shot.
        found: result of the scan; ``None`` before it.
        made: number of frames that were denoised in this run.
        failed: for each failed frame, by number, the reason.
        reason: why the whole shot failed; empty if it did not.
        summary: of the finished frames; ``None`` before the last task of the shot.
        traces: tracebacks of failures that the input did not cause.
        begun: time at which the first piece was started, seconds.
        ended: time at which the last piece ended, seconds.
        repeated: number of frames that were denoised again because their files had changed meanwhile.
        pieces: number of pieces into which the shot was cut.
        waiting: number of pieces that have not ended.
    """

    shot: Shot
    found: Found | None = None
    made: int = 0
    failed: dict[int, str] = field(default_factory=dict)
    reason: str = ""
    summary: Summary | None = None
    traces: list[str] = field(default_factory=list)
    begun: float = 0.0
    ended: float = 0.0
    repeated: int = 0
    pieces: int = 0
    waiting: int = 0

    @property
    def complete(self) -> bool:
        """Whether every frame is finished."""
        return self.summary is not None and not self.failed and not self.reason

    @property
    def rate(self) -> float:
        """Frames a second, from the beginning of the first piece to the end of the last."""
        return self.made / max(self.ended - self.begun, 1e-3) if self.made else 0.0

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


@dataclass
class _Task:
    """One task, with what its retry needs."""

    kind: str
    result: ShotResult
    piece: Piece | None = None
    journal: Path | None = None
    tail: Tail | None = None
    lost: int = 0


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
            run = _Run(film, engine, on_progress, on_shot)
            try:
                return run.run()
            finally:
                engine.close()
                run.sweep()
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


class _Run:
    def __init__(
        self,
        film: Film,
        engine: Engine,
        on_progress: Callable[[int, int | None], None],
        on_shot: Callable[[ShotResult], None],
    ) -> None:
        self.film, self.engine, self.on_progress, self.on_shot = film, engine, on_progress, on_shot
        self.result = FilmResult([ShotResult(shot) for shot in film.shots])
        # All shots are scanned first, so that wrong input is reported early and the time left is known.
        self.queue = deque(_Task("scan", each) for each in self.result.shots)
        self.running: dict[Hashable, _Task] = {}
        self.unscanned = len(film.shots)
        self.began = self.counted = time.monotonic()
        self.reported: tuple[int, int | None] = (-1, None)

    def run(self) -> FilmResult:
        created = datetime.now(UTC).isoformat(timespec="seconds")
        try:
            while self.queue or self.running:
                for _ in range(min(len(self.queue), self.engine.free_slots()) if self.queue else 0):
                    self._submit(self.queue.popleft())
                for handle, done in self.engine.finished(_SECONDS_BETWEEN_POLLS).items():
                    self._ended(self.running.pop(handle), done)
                self._count()
        finally:
            self.result.seconds = time.monotonic() - self.began
            try:
                write_json(self.film.out / FILE, _as_json(self.film, self.result, created))
            except InputError as error:
                self.result.trouble = str(error)
        return self.result

    def sweep(self) -> None:
        """Remove the half-written files of workers that were killed; no worker is alive any more."""
        for each in self.result.shots:
            if each.begun:
                order = self.film.order(each.shot)
                for folder in (order.folder, order.records):
                    sweep(folder, youngest=0)

    def _submit(self, task: _Task) -> None:
        result = task.result
        shot = result.found.shot if result.found is not None else result.shot
        order = self.film.order(shot)
        if task.kind == "scan":
            handle = self.engine.submit(work.scan, order)
        elif task.kind == "summarize":
            handle = self.engine.submit(work.summarize, order)
        else:
            # A new name for each attempt, because a lost worker may still be alive and write to the old one.
            task.journal = order.records / f"{secrets.token_hex(8)}.jsonl"
            task.tail = Tail(task.journal)
            result.begun = result.begun or time.monotonic()
            handle = self.engine.submit(work.make, order, task.piece, task.journal)
        self.running[handle] = task

    def _ended(self, task: _Task, done: Done) -> None:
        if task.tail is not None:
            new = task.tail.new()
            task.result.made += new
        if done.lost:
            self._lost(task, done.lost)
        elif done.error is not None:
            self._failed(task, done.error)
        elif task.kind == "scan":
            self._scanned(task.result, done.answer)
        elif task.kind == "make":
            self._made(task, done.answer)
        else:
            self._summarized(task.result, done.answer)

    def _scanned(self, result: ShotResult, found: Found) -> None:
        self.unscanned -= 1
        result.found = found
        result.failed.update(found.unreadable)
        self._cut(result, set(found.numbers) - found.done)
        if not result.waiting:
            self._summarize(result)

    def _cut(self, result: ShotResult, missing: set[int], lost: int = 0) -> None:
        if result.found is None:
            return
        pieces = cut(result.found.numbers, missing, self.film.piece, result.found.overlap)
        tasks = [_Task("make", result, piece, lost=lost) for piece in pieces]
        result.pieces = result.pieces or len(pieces)
        result.waiting += len(pieces)
        # Retries come first, because their shots are nearest to their ends.
        self.queue.extendleft(reversed(tasks)) if lost else self.queue.extend(tasks)

    def _made(self, task: _Task, made: Made) -> None:
        task.result.failed.update(made.failed)
        if made.trace:
            task.result.traces.append(made.trace)
        self._piece_ended(task.result)

    def _piece_ended(self, result: ShotResult) -> None:
        result.waiting -= 1
        result.ended = time.monotonic()
        if not result.waiting:
            self._summarize(result)

    def _summarize(self, result: ShotResult) -> None:
        self.queue.appendleft(_Task("summarize", result))

    def _summarized(self, result: ShotResult, summary: Summary) -> None:
        """Denoise frames again whose files have changed meanwhile, once; those that change again are not finished."""
        changed = set(summary.unfinished) - set(result.failed)
        if changed and not result.repeated:
            result.repeated = len(changed)
            self._cut(result, changed)
            return
        reason = "its files have changed while the film was made, and once more; run the same command when they stay"
        result.failed.update(dict.fromkeys(changed, reason))
        result.summary = summary
        self.on_shot(result)

    def _lost(self, task: _Task, why: str) -> None:
        """Retry a task whose worker is lost; the frames that it has finished are on the disk."""
        done = _finished(task)
        task.lost = 1 if done else task.lost + 1
        if task.lost >= MOST_LOSSES:
            self._failed(task, InputError(f"{why}, {task.lost} times in a row"))
        elif task.piece is None:
            self.queue.appendleft(_Task(task.kind, task.result, lost=task.lost))
        else:
            self._cut(task.result, set(task.piece.wanted) - done, task.lost)
            self._piece_ended(task.result)

    def _failed(self, task: _Task, error: BaseException) -> None:
        result, reason = task.result, describe_error(error)
        if task.piece is not None:
            result.failed.update(dict.fromkeys(set(task.piece.wanted) - _finished(task), reason))
            self._piece_ended(result)
            return
        if task.kind == "scan":
            self.unscanned -= 1
        result.reason = reason
        self.on_shot(result)

    def _count(self) -> None:
        """Report the number of finished frames, if some time has passed since the last report."""
        pause = max(_SECONDS_BETWEEN_COUNTS, _SECONDS_A_JOURNAL * len(self.running))
        if time.monotonic() - self.counted >= pause:
            self.counted = time.monotonic()
            for task in self.running.values():
                if task.tail is not None:
                    task.result.made += task.tail.new()
        known = [each for each in self.result.shots if each.found is not None]
        total = sum(
            len(each.found.numbers) - len(each.found.done) + each.repeated for each in known if each.found is not None
        )
        progress = (self.result.made, None if self.unscanned else total)
        if progress != self.reported:
            self.reported = progress
            self.on_progress(*progress)


def _finished(task: _Task) -> set[int]:
    return {record.number for record in read_journal(task.journal)} if task.journal is not None else set()


def _as_json(film: Film, result: FilmResult, created: str) -> dict[str, Any]:
    return {
        "created": created,
        "version": version("mcdenoise"),
        "complete": result.complete,
        "seconds": round(result.seconds, 3),
        "frames_made": result.made,
        "piece": film.piece,
        "joint_tolerance": film.joint,
        "shots": [_shot_as_json(each) for each in result.shots],
    }


def _shot_as_json(result: ShotResult) -> dict[str, Any]:
    shot = result.found.shot if result.found is not None else result.shot
    settings = {key: value for key, value in asdict(shot.settings).items() if value not in (None, (), False)}
    about: dict[str, Any] = {
        "name": shot.name,
        "input": [str(path) for path in shot.inputs],
        "settings": {key: str(value) if isinstance(value, Path) else value for key, value in settings.items()},
        "complete": result.complete,
        "made": result.made,
        "frames_per_second": round(result.rate, 3),
        "pieces": result.pieces,
        "failed": [{"frames": frames, "why": why} for frames, why in result.failures()],
        "traces": result.traces,
    }
    if result.found is not None:
        found = {"frames": list(result.found.numbers), "found_finished": len(result.found.done)}
        about |= {**found, "overlap": result.found.overlap, "picked": shot.picked}
    if result.summary is not None:
        about |= _summary_as_json(result.summary)
    return about


def _summary_as_json(summary: Summary) -> Mapping[str, Any]:
    return {
        "milliseconds": summary.milliseconds,
        "joints": {str(number): difference for number, difference in summary.joints.items()},
        "worst": [row["number"] for row in sorted(summary.frames, key=lambda row: -row["score"])[:3]],
        "resets": {str(row["number"]): row["reset"] for row in summary.frames if row["reset"]},
        "warnings": list(summary.warnings),
    }
