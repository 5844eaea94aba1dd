"""Hands out the tasks of a film, and knows how far it is: all that it knows besides is on the disk."""

from __future__ import annotations

import json
import os
import secrets
import time
from collections import deque
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from mcdenoise.data.files import held, sweep, write_text
from mcdenoise.engines import MOST_LOSSES, Done, Engine, describe_error
from mcdenoise.errors import InputError
from mcdenoise.film import work
from mcdenoise.film.manifest import Shot
from mcdenoise.film.pieces import Piece, cut
from mcdenoise.film.record import Tail, read_journal
from mcdenoise.film.work import RECORDS, Closed, Found, Made, Order
from mcdenoise.folder import make_folder

_SECONDS_BETWEEN_LOOKS = 0.2
# Seconds between looks at all journals: a thousand of them cost no more than some hundred questions a second.
_SECONDS_BETWEEN_COUNTS, _SECONDS_A_JOURNAL = 0.5, 0.002
FILE = "film.json"


@dataclass(frozen=True)
class Film:
    """What is to be made.

    Args:
        shots: in the order in which they are begun.
        out: folder; each shot has one in it.
        piece: the most frames that one process makes of a shot; 0 for no limit.
        joint: how far a frame may differ from that of the uncut shot, as a fraction.
        threads: of torch in each process.
    """

    shots: Sequence[Shot]
    out: Path
    piece: int = 200
    joint: float = 1e-2
    threads: int | None = None

    def order(self, shot: Shot) -> Order:
        """What every task of a shot is told."""
        return Order(shot, Path(os.path.abspath(self.out)), self.joint, self.threads)


@dataclass
class ShotResult:
    """How far a shot is.

    Args:
        shot: which.
        found: when it has been looked at.
        made: frames that were made in this run.
        failed: why, by number of the frame.
        reason: why the shot as a whole could not be made.
        closed: when all is made that can be.
        traces: of failures that are no fault of the input.
        begun: seconds, of the first piece.
        ended: seconds, of the last.
        pieces: in which the shot was cut.
        waiting: pieces that are not made yet.
    """

    shot: Shot
    found: Found | None = None
    made: int = 0
    failed: dict[int, str] = field(default_factory=dict)
    reason: str = ""
    closed: Closed | None = None
    traces: list[str] = field(default_factory=list)
    begun: float = 0.0
    ended: float = 0.0
    pieces: int = 0
    waiting: int = 0

    @property
    def complete(self) -> bool:
        """Whether every frame is there."""
        return self.closed is not None and not self.failed and not self.reason

    @property
    def rate(self) -> float:
        """Frames a second, from the beginning of the first piece to the end of the last."""
        return self.made / max(self.ended - self.begun, 1e-3) if self.made else 0.0

    def failures(self) -> list[tuple[str, str]]:
        """Frames, and why they are not there; neighbours with one reason are one row."""
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
    """How a film has ended.

    Args:
        shots: in the order of the film.
        seconds: that it took.
        trouble: why ``film.json`` could not be written.
    """

    shots: list[ShotResult]
    seconds: float = 0.0
    trouble: str = ""

    @property
    def complete(self) -> bool:
        """Whether every frame of every shot is there."""
        return not self.trouble and all(each.complete for each in self.shots)

    @property
    def made(self) -> int:
        """Frames that were made in this run."""
        return sum(each.made for each in self.shots)


@dataclass
class _Task:
    """One task, with what is needed to do it again."""

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
    """Make a film: look at every shot, make what is missing, and close each shot.

    What fails, fails alone: it is in the result, and the rest goes on. The same call again goes on where this one
    ended, however that was. Writes ``OUT/film.json`` when it ends, in whatever way.

    Args:
        film: what is to be made.
        engine: who makes it; is closed in the end.
        on_progress: called with how many frames were made, and how many there are to be made as far as that is known:
            ``None`` while shots are looked at.
        on_shot: called with each shot that is closed or given up.

    Raises:
        InputError: the folder cannot be written to, or another process makes a film in it.
    """
    try:
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
        # Looks first: then what is wrong is known at once, and how long all takes.
        self.queue = deque(_Task("look", each) for each in self.result.shots)
        self.running: dict[Hashable, _Task] = {}
        self.looking = len(film.shots)
        self.began = self.counted = time.monotonic()
        self.said: tuple[int, int | None] = (-1, None)

    def run(self) -> FilmResult:
        created = datetime.now(UTC).isoformat(timespec="seconds")
        try:
            while self.queue or self.running:
                room = self.engine.free_slots() if self.queue else 0
                while self.queue and room > 0:
                    self._submit(self.queue.popleft())
                    room -= 1
                for handle, done in self.engine.finished(_SECONDS_BETWEEN_LOOKS).items():
                    self._ended(self.running.pop(handle), done)
                self._count()
        finally:
            self.result.seconds = time.monotonic() - self.began
            content = json.dumps(_as_json(self.film, self.result, created), indent=1, allow_nan=False)
            try:
                write_text(self.film.out / FILE, content + "\n")
            except InputError as error:
                self.result.trouble = str(error)
        return self.result

    def sweep(self) -> None:
        """Remove what processes left over that were ended while they wrote: there are none any more."""
        for each in self.result.shots:
            if each.begun:
                order = self.film.order(each.shot)
                for folder in (order.folder, order.records):
                    sweep(folder, youngest=0)

    def _submit(self, task: _Task) -> None:
        result = task.result
        shot = result.found.shot if result.found is not None else result.shot
        order = self.film.order(shot)
        if task.kind == "look":
            handle = self.engine.submit(work.look, order)
        elif task.kind == "close":
            handle = self.engine.submit(work.close, order)
        else:
            # A name that no other has: who is thought to be dead may write still.
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
        elif task.kind == "look":
            self._looked(task.result, done.answer)
        elif task.kind == "make":
            self._made(task, done.answer)
        else:
            task.result.closed = done.answer
            self.on_shot(task.result)

    def _looked(self, result: ShotResult, found: Found) -> None:
        self.looking -= 1
        result.found = found
        result.failed.update(found.unreadable)
        self._cut(result, set(found.numbers) - found.done)
        if not result.waiting:
            self._close(result)

    def _cut(self, result: ShotResult, missing: set[int], lost: int = 0) -> None:
        if result.found is None:
            return
        pieces = cut(result.found.numbers, missing, self.film.piece, result.found.overlap)
        tasks = [_Task("make", result, piece, lost=lost) for piece in pieces]
        result.pieces = result.pieces or len(pieces)
        result.waiting += len(pieces)
        # What was lost comes first: its shot is nearest to its end.
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
            self._close(result)

    def _close(self, result: ShotResult) -> None:
        self.queue.appendleft(_Task("close", result))

    def _lost(self, task: _Task, why: str) -> None:
        """The process is no more; what it has finished is on the disk."""
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
        if task.kind == "look":
            self.looking -= 1
        result.reason = reason
        self.on_shot(result)

    def _count(self) -> None:
        """Count what is finished, now and then."""
        pause = max(_SECONDS_BETWEEN_COUNTS, _SECONDS_A_JOURNAL * len(self.running))
        if time.monotonic() - self.counted >= pause:
            self.counted = time.monotonic()
            for task in self.running.values():
                if task.tail is not None:
                    task.result.made += task.tail.new()
        known = [each for each in self.result.shots if each.found is not None]
        total = sum(len(each.found.numbers) - len(each.found.done) for each in known if each.found is not None)
        told = (self.result.made, None if self.looking else total)
        if told != self.said:
            self.said = told
            self.on_progress(*told)


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
        about |= {**found, "overlap": result.found.overlap, "chosen": result.found.choice}
    if result.closed is not None:
        about |= _closed_as_json(result.closed)
    return about


def _closed_as_json(closed: Closed) -> Mapping[str, Any]:
    return {
        "milliseconds": closed.milliseconds,
        "joints": {str(number): difference for number, difference in closed.joints.items()},
        "worst": [row["number"] for row in sorted(closed.frames, key=lambda row: -row["score"])[:3]],
        "resets": {str(row["number"]): row["reset"] for row in closed.frames if row["reset"]},
        "warnings": list(closed.warnings),
    }
