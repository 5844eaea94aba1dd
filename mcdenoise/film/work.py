"""The tasks of a film: scan a shot, denoise a piece of it, and summarize it when all pieces have ended.

A task depends on its arguments and on the disk alone, so that any worker can run it, and retry it. Arguments and
answers are small: workers read and write the frames themselves.
"""

from __future__ import annotations

import functools
import os
import secrets
from collections.abc import Collection, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.commit import source_commit
from mcdenoise.data import Sequence
from mcdenoise.data.files import remove, sweep
from mcdenoise.data.readers.opening import open_result
from mcdenoise.data.sequences import frame_numbers
from mcdenoise.denoiser import Denoiser
from mcdenoise.engines import describe_error
from mcdenoise.errors import InputError
from mcdenoise.film.manifest import PICTURES, Shot
from mcdenoise.film.pieces import Piece, cut
from mcdenoise.film.record import (
    FrameRecord,
    Journal,
    Stamp,
    digest_of,
    digest_text,
    read_records,
    stamp,
    stamp_and_digest,
)
from mcdenoise.folder import FrameError, check_apart, make_folder, new_report, write_frames, write_report
from mcdenoise.heap import keep_heap, return_heap
from mcdenoise.models import find_weights, frames_remembered
from mcdenoise.preview import Preview

# Folder of the records, beside the shots.
RECORDS = ".film"
# Settings that change no pixel of a result.
_SILENT = {"frames", "threads", "preview", "preview_fps", "preview_exposure", "results", "max_memory"}
# Largest side of the images whose change is measured, and of a thumbnail; thumbnails in the strip, and of the worst.
_SMALL, _THUMBNAIL, _STRIP, _WORST = 64, 320, 6, 3


@dataclass(frozen=True)
class Order:
    """The arguments that all tasks of a shot have in common.

    Args:
        shot: the shot.
        out: folder of the film, as an absolute path.
        joint: see :class:`mcdenoise.film.Film`.
        threads: of torch; ``None`` for its own choice.
        run: the beginning of the names of the journals of this run.
    """

    shot: Shot
    out: Path
    joint: float
    threads: int | None = None
    run: str = ""

    @property
    def folder(self) -> Path:
        """The folder to which the frames are written."""
        return self.out / self.shot.name

    @property
    def records(self) -> Path:
        """The folder of the journals."""
        return self.out / RECORDS / self.shot.name

    def result(self, record: FrameRecord) -> Path:
        """The file of a finished frame, also after the film's folder was moved."""
        return self.folder / record.result[0]

    def has(self, record: FrameRecord) -> bool:
        """Whether that file is still as it was written."""
        try:
            return stamp(self.result(record))[1:] == record.result[1:]
        except OSError:
            return False


@dataclass(frozen=True)
class Found:
    """The result of :func:`scan`.

    Args:
        shot: the shot, with the model that was picked, if none is named.
        numbers: numbers of all frames.
        done: numbers of the finished frames.
        unreadable: for each frame that cannot be opened, by number, the reason.
        overlap: number of frames that the history needs, see :func:`mcdenoise.models.frames_remembered`.
    """

    shot: Shot
    numbers: tuple[int, ...]
    done: frozenset[int]
    unreadable: Mapping[int, str]
    overlap: int | None


@dataclass(frozen=True)
class Summary:
    """The summary of a shot.

    Args:
        milliseconds: median run time of each stage.
        frames: for each frame ``number``, ``change``, ``history``, ``reset``, ``replaced_pixels`` and ``score``.
        pictures: paths of the thumbnails, by number of the frame, relative to the page.
        warnings: what is probably wrong, a line each.
        unfinished: the numbers of all other frames: those that failed, and those whose files have changed meanwhile.
    """

    milliseconds: Mapping[str, float]
    frames: tuple[Mapping[str, Any], ...]
    pictures: Mapping[int, str]
    warnings: tuple[str, ...]
    unfinished: frozenset[int] = frozenset()


@dataclass(frozen=True)
class _Opened:
    """A shot with its frames opened, and its denoiser."""

    shot: Shot
    sequence: Sequence
    denoiser: Denoiser
    overlap: int | None
    unreadable: Mapping[int, str]
    settings: str

    def window(self, number: int) -> list[int]:
        """The frame, and the frames in its history."""
        place = self.sequence.numbers.index(number)
        first = 0 if self.overlap is None else max(0, place - self.overlap)
        return self.sequence.numbers[first : place + 1]


class _Keys:
    """Keys of frames. Frames are asked for in ascending order, so that each file is read at most once.

    A digest that is taken before the frame is read is that of the pixels, or of a file that is replaced meanwhile: then
    it is that of no file any more, and the frame is not taken for a finished one.

    Args:
        opened: the shot.
    """

    def __init__(self, opened: _Opened) -> None:
        self.opened = opened
        self._recorded: dict[Stamp, str] = {}
        self._inputs: dict[int, tuple[tuple[Stamp, str], ...]] = {}

    def inputs(self, number: int) -> tuple[tuple[Stamp, str], ...]:
        """Stamps and digests of the files of a frame."""
        if number not in self._inputs:
            self._inputs[number] = tuple(
                stamp_and_digest(path, self._recorded) for path in self.opened.sequence.files(number)
            )
        return self._inputs[number]

    def key(self, number: int) -> str:
        """The key of a frame: a digest of all that decides its result."""
        window = self.opened.window(number)
        key = digest_text(self.opened.settings, *(digest for each in window for _, digest in self.inputs(each)))
        # The next frames are added in another thread.
        for each in [each for each in list(self._inputs) if each < window[0]]:
            del self._inputs[each]
        return key

    def finished(self, order: Order, numbers: Iterable[int]) -> dict[int, FrameRecord]:
        """The records of those frames that are finished: whose results, inputs and settings are still the recorded."""
        records = read_records(order.records)
        self._recorded = dict(each for record in records.values() for each in record.inputs)
        there = [n for n in numbers if n in records and order.has(records[n])]
        return {n: records[n] for n in there if records[n].key == self.key(n)}


def scan(order: Order) -> Found:
    """A task: find the frames of a shot, and which of them are finished.

    Raises:
        InputError: the shot cannot be opened, or cannot be denoised with these settings.
    """
    opened = _opened(order)
    numbers = tuple(opened.sequence.numbers)
    done = frozenset(_Keys(opened).finished(order, numbers))
    return Found(opened.shot, numbers, done, opened.unreadable, opened.overlap)


def make(order: Order, piece: Piece) -> dict[int, str]:
    """A task: denoise the frames of a piece that are not finished, and record each as it is.

    Args:
        order: of the shot.
        piece: the frames.

    Returns:
        For each failed frame, by number, the reason. A damaged frame fails alone, and the history begins anew after it;
        where a result cannot be written, all frames that are left fail.

    Raises:
        InputError: as :func:`scan`.
    """
    opened = _opened(order)
    make_folder(order.folder)
    check_apart(opened.sequence, order.folder)
    # That file says that the shot is complete.
    remove(order.folder / "denoise.json")
    left = set(piece.wanted) - _Keys(opened).finished(order, piece.wanted).keys()
    failed: dict[int, str] = {}
    try:
        with Journal.open(order.records / f"{order.run}{secrets.token_hex(8)}.jsonl") as journal:
            # A piece whose worker was lost goes on where it was, with the frames before that give it its history.
            for part in cut(piece.numbers, left, 0, opened.overlap):
                numbers, keys = list(part.numbers), _Keys(opened)
                while left & set(numbers):
                    try:
                        _Writer(order, keys, journal, left).write(numbers)
                    except FrameError as error:
                        numbers = [number for number in numbers if number > error.number]
                        failed |= {number: str(error) for number in left & {error.number}}
                        left -= {error.number}
    except Exception as error:  # also of a user's model, or for lack of memory
        failed |= dict.fromkeys(left, describe_error(error))
    return failed


def summarize(order: Order) -> Summary:
    """A task: write ``denoise.json`` of a complete shot, its thumbnails and its preview.

    Raises:
        InputError: as :func:`scan`, or something cannot be written.
    """
    opened = _opened(order)
    found = _Keys(opened).finished(order, opened.sequence.numbers)
    records = list(found.values())
    report = new_report(opened.sequence, _name(opened.shot), opened.shot.picked)
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
    described = _described(records)
    warnings = [*opened.sequence.warnings, *(report.warnings if records else [])]
    return Summary(
        report.milliseconds if records else {},
        tuple(described),
        _pictures(order, records, described),
        tuple(warnings),
        unfinished,
    )


class _Writer:
    """Denoises frames, and records each as it is finished."""

    def __init__(self, order: Order, keys: _Keys, journal: Journal, left: set[int]) -> None:
        self.order, self.keys, self.journal, self.left = order, keys, journal, left
        self.opened = keys.opened
        self.report = new_report(self.opened.sequence, "")
        self.small: Tensor | None = None

    def write(self, numbers: list[int]) -> None:
        """Denoise frames, and write those of them that are not finished."""
        settings, sequence = self.opened.shot.settings, self.opened.sequence
        write_frames(
            sequence.part(numbers),
            self.order.folder,
            self.opened.denoiser,
            self.report,
            full_float=settings.full_float,
            output_layer=settings.output_layer,
            unwritten=[number for number in numbers if number not in self.left],
            of=len(sequence),
            on_read=self.keys.inputs,
            on_file=self.finished,
        )

    def finished(self, number: int, image: Tensor) -> None:
        """Record a frame; called in the thread that has written its file."""
        before, self.small = self.small, _small(image)
        report = self.report.frames.pop(number)
        if number not in self.left:
            return
        path = self.report.files.pop(number)
        record = FrameRecord(
            number,
            self.keys.key(number),
            (path.relative_to(self.order.folder).as_posix(), *stamp(path)[1:]),
            self.keys.inputs(number),
            report,
            number in self.report.alike,
            None if before is None else _difference(self.small, before),
        )
        self.journal.add(record)
        self.left.discard(number)


@functools.lru_cache(1)
def _opened(order: Order) -> _Opened:
    """Open a shot; the last one is cached, because a worker may denoise several pieces of it."""
    keep_heap()
    if order.shot.settings.max_memory is not None:
        return_heap()
    threads = order.shot.settings.threads or order.threads
    if threads is not None:
        torch.set_num_threads(threads)
    sequence, unreadable = _open_what_opens(order.shot)
    settings, choice = order.shot.settings.chosen(sequence)
    # Digested first: if the file changes while it is read, the frames belong to a digest that no file has.
    weights = _weights(settings)
    denoiser = _denoiser(replace(settings, frames=None), *weights)
    denoiser.reset(frames=len(sequence))
    streams = len(sequence) > 1 and denoiser.has_history(sequence.buffers)
    overlap = frames_remembered(denoiser.model, order.joint) if streams else 0
    listed = {key: str(value) for key, value in asdict(settings).items() if key not in _SILENT}
    # References do not change a result.
    rows = [str(row) for row in sequence.table if row.buffer != "reference"]
    described = digest_text(
        version("mcdenoise"), source_commit(), repr(sorted(listed.items())), *weights, *rows, str(overlap)
    )
    # After the scan the model is named, and the reason is that of the scan.
    shot = replace(order.shot, settings=settings, picked=choice or order.shot.picked)
    return _Opened(shot, sequence, denoiser, overlap, unreadable, described)


@functools.lru_cache(1)
def _denoiser(settings: Any, *weights: str) -> Denoiser:
    """The denoiser; the digests of its files are there for the cache."""
    denoiser: Denoiser = settings.denoiser()
    return denoiser


def _open_what_opens(shot: Shot) -> tuple[Sequence, dict[int, str]]:
    """Open all frames that can be opened, with the reasons of the others: a damaged file costs a film one frame."""
    settings = shot.settings
    try:
        return settings.open(shot.inputs), {}
    except InputError as error:
        refused: dict[int, str] = {}
        numbers = frame_numbers(shot.inputs, settings.frames)
        for number in numbers:
            try:
                replace(settings, frames=str(number)).open(shot.inputs)
            except InputError as own:
                refused[number] = str(own)
        good = [number for number in numbers if number not in refused]
        if not good or not refused:
            raise
        try:
            return replace(settings, frames=",".join(map(str, good))).open(shot.inputs), refused
        except InputError:
            raise error from None


def _weights(settings: Any) -> list[str]:
    """Digests of the model's files: its weights, or its source if it is the user's."""
    spelling = settings.spelling
    paths = [spelling.weights] if spelling.weights else []
    if ".py:" in spelling.model:
        paths.append(Path(spelling.model.rpartition(":")[0]))
    elif not paths and ":" not in spelling.model:
        paths += [path for path in [find_weights(spelling.model)] if path is not None]
    try:
        return [digest_of(path) for path in paths]
    except OSError as error:
        raise InputError(f"{paths[0]}: expected a file to read, found: {error.strerror}; check the path") from error


def _name(shot: Shot) -> str:
    spelling = shot.settings.spelling
    return str(spelling.weights or spelling.name)


def _small(image: Tensor) -> Tensor:
    """A small image whose change from frame to frame is measured."""
    height, width = image.shape[-2:]
    scale = _SMALL / max(height, width, _SMALL)
    size = (max(1, round(height * scale)), max(1, round(width * scale)))
    return torch.log1p(F.adaptive_avg_pool2d(image.detach().float(), size).clamp(0, 1e16)).cpu()


def _difference(one: Tensor, other: Tensor) -> float | None:
    if one.shape != other.shape:
        return None
    return float((one - other).abs().mean() / (one.mean() + other.mean()).clamp_min(1e-6))


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


def _pictures(order: Order, records: list[FrameRecord], described: list[dict[str, Any]]) -> dict[int, str]:
    """Write thumbnails of the frames with the highest scores, and of some frames across the shot."""
    if not records:
        return {}
    worst = sorted(described, key=lambda row: (-row["score"], row["number"]))[:_WORST]
    steps = np.linspace(0, len(records) - 1, min(_STRIP, len(records))).round().astype(int)
    wanted = {row["number"] for row in worst} | {records[step].number for step in steps}
    shown = Preview(order.out / PICTURES / order.shot.name, video=False)
    found = {}
    for record in records:
        if record.number not in wanted:
            continue
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


def _preview(order: Order, opened: _Opened, files: Mapping[int, Path]) -> None:
    """Write the preview of `mcdenoise denoise --preview` from the files, whose frames were denoised in any order."""
    shown = opened.shot.settings.preview_in(order.folder, video=len(files) > 1)
    for path in files.values():
        image, metadata = open_result(path).read(opened.sequence.window)
        shown.add(path.stem, image, metadata)
    shown.close()
