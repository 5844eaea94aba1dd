"""The tasks of a film: scan a shot, denoise a piece of it, and summarize it.

A task depends on its arguments and on the disk alone, so that any worker can run it, and retry it. Arguments and
answers are small: workers read and write the frames themselves.
"""

from __future__ import annotations

import functools
import os
import secrets
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.commit import source_commit
from mcdenoise.data import Sequence
from mcdenoise.data.files import make_folder, remove, sweep
from mcdenoise.data.readers.opening import open_result
from mcdenoise.data.sequences import frame_numbers
from mcdenoise.denoiser import Denoiser
from mcdenoise.engines import describe_error
from mcdenoise.errors import InputError
from mcdenoise.film.manifest import PICTURES, Shot
from mcdenoise.film.pieces import Piece, cut
from mcdenoise.film.record import (
    FrameRecord,
    Stamp,
    digest_of,
    digest_text,
    read_records,
    result_stamp,
    stamp_and_digest,
)
from mcdenoise.folder import FrameError, check_apart, new_report, write_frames, write_report
from mcdenoise.heap import keep_heap, return_heap
from mcdenoise.models._remembered import frames_remembered
from mcdenoise.models._weights import find_weights
from mcdenoise.preview import Preview

# Folder of the records, beside the shots.
RECORDS = ".film"
# Settings that change no pixel of a result.
_SILENT = {"frames", "threads", "preview", "preview_fps", "preview_exposure", "results", "max_memory"}
# Largest side of the images whose change is measured, and of a thumbnail.
_SMALL, _THUMBNAIL = 64, 320
# Thumbnails across the shot, and of its worst frames.
_STRIP, _WORST = 6, 3


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

    def made(self) -> int:
        """Number of frames that this run has finished, while workers add records of them."""
        count = 0
        for path in self.records.glob(f"{self.run}*.jsonl"):
            with suppress(OSError), path.open("rb") as journal:
                # A line that is still being written is counted by the next call.
                count += sum(line.startswith(b"{") and line.endswith(b"\n") for line in journal)
        return count


@dataclass(frozen=True)
class Found:
    """The result of :func:`scan`.

    Args:
        shot: the shot, with the model that limits have picked, if there are any.
        numbers: numbers of all frames.
        unreadable: for each frame that cannot be opened, by number, the reason.
        overlap: number of frames that the history needs.
        done: numbers of the finished frames.
    """

    shot: Shot
    numbers: tuple[int, ...]
    unreadable: Mapping[int, str]
    overlap: int | None
    done: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Opened:
    """A shot with its frames opened, its denoiser, and a digest of all settings that decide a result."""

    found: Found
    sequence: Sequence
    denoiser: Denoiser
    settings: str


class Keys:
    """Keys of frames, for which each file is read at most once.

    A digest that is taken before the frame is read is that of the pixels, or of a file that is replaced meanwhile: then
    it is that of no file any more, and the frame is not taken for a finished one.

    Args:
        opened: the shot.
    """

    def __init__(self, opened: Opened) -> None:
        self.opened = opened
        self._recorded: dict[Stamp, str] = {}
        self._inputs: dict[int, tuple[tuple[Stamp, str], ...]] = {}

    def inputs(self, number: int) -> tuple[tuple[Stamp, str], ...]:
        """Stamps and digests of the files of a frame."""
        if number not in self._inputs:
            files = self.opened.sequence.files(number)
            self._inputs[number] = tuple(stamp_and_digest(path, self._recorded) for path in files)
        return self._inputs[number]

    def key(self, number: int) -> str:
        """The key of a frame: a digest of all that decides its result, with the frames in its history."""
        numbers, overlap = self.opened.sequence.numbers, self.opened.found.overlap
        place = numbers.index(number)
        window = numbers[0 if overlap is None else max(0, place - overlap) : place + 1]
        return digest_text(self.opened.settings, *(digest for each in window for _, digest in self.inputs(each)))

    def finished(self, order: Order, numbers: Iterable[int]) -> dict[int, FrameRecord]:
        """The records of those frames that are finished: whose results, inputs and settings are still the recorded."""
        records = read_records(order.records)
        self._recorded = dict(each for record in records.values() for each in record.inputs)
        there = [n for n in numbers if n in records and records[n].is_there(order.folder)]
        return {n: records[n] for n in there if records[n].key == self.key(n)}


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


def scan(order: Order) -> Found:
    """A task: find the frames of a shot, and which of them are finished.

    Raises:
        InputError: the shot cannot be opened, or cannot be denoised with these settings.
    """
    opened = open_order(order)
    return replace(opened.found, done=frozenset(Keys(opened).finished(order, opened.found.numbers)))


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
    opened = open_order(order)
    make_folder(order.folder)
    check_apart(opened.sequence, order.folder)
    # That file says that the shot is complete.
    remove(order.folder / "denoise.json")
    left = set(piece.wanted) - Keys(opened).finished(order, piece.wanted).keys()
    failed: dict[int, str] = {}
    try:
        make_folder(order.records)
        with (order.records / f"{order.run}{secrets.token_hex(8)}.jsonl").open("ab", buffering=0) as journal:
            # A piece whose worker was lost goes on where it was, with the frames before that give it its history.
            for part in cut(piece.numbers, left, 0, opened.found.overlap):
                numbers, keys = list(part.numbers), Keys(opened)
                while left & set(numbers):
                    try:
                        _write(order, keys, numbers, left, journal)
                    except FrameError as error:
                        numbers = [number for number in numbers if number > error.number]
                        failed |= {number: str(error) for number in left & {error.number}}
                        left -= {error.number}
    except Exception as error:  # also of a user's model, or for lack of memory
        failed |= dict.fromkeys(left, describe_error(error))
    return failed


def _write(order: Order, keys: Keys, numbers: list[int], left: set[int], journal: BinaryIO) -> None:
    """Denoise frames, write those that are left, and record each as it is finished, which takes it from them."""
    opened = keys.opened
    settings = opened.found.shot.settings
    report = new_report(opened.sequence, "")
    shown: Tensor | None = None

    def finished(number: int, image: Tensor) -> None:
        """Called in the thread that has written the file."""
        nonlocal shown
        before, shown = shown, _small(image)
        done = report.frames.pop(number)
        if number in left:
            stamp = result_stamp(report.files.pop(number))
            change = None if before is None else _difference(shown, before)
            alike = number in report.alike
            FrameRecord(number, keys.key(number), stamp, keys.inputs(number), done, alike, change).write(journal)
            left.discard(number)

    write_frames(
        opened.sequence.part(numbers),
        order.folder,
        opened.denoiser,
        report,
        full_float=settings.full_float,
        output_layer=settings.output_layer,
        unwritten=[number for number in numbers if number not in left],
        of=len(opened.sequence),
        on_read=keys.inputs,
        on_file=finished,
    )


def summarize(order: Order) -> Summary:
    """A task: write ``denoise.json`` of a complete shot, its thumbnails and its preview.

    Raises:
        InputError: as :func:`scan`, or something cannot be written.
    """
    opened = open_order(order)
    shot, sequence = opened.found.shot, opened.sequence
    found = Keys(opened).finished(order, sequence.numbers)
    spelling = shot.settings.spelling
    report = new_report(sequence, str(spelling.weights or spelling.name), shot.picked)
    report.frames = {number: each.report for number, each in found.items()}
    report.files = {number: order.folder / each.result[0] for number, each in found.items()}
    report.alike = [number for number, each in found.items() if each.alike]
    for folder in (order.folder, order.records):
        sweep(folder, youngest=0)
    unfinished = frozenset(sequence.numbers) - found.keys()
    if not unfinished and not opened.found.unreadable:
        write_report(sequence, order.folder, opened.denoiser, report)
        if shot.settings.preview:
            # From the files, since frames were denoised in any order.
            shown = shot.settings.preview_in(order.folder, video=len(found) > 1)
            for path in report.files.values():
                shown.add(path.stem, *open_result(path).read(sequence.window))
            shown.close()
    warnings = [*sequence.warnings, *(report.warnings if found else [])]
    rows = _described(found)
    worst = sorted(rows, key=lambda row: (-row["score"], row["number"]))[:_WORST]
    steps = np.linspace(0, len(rows) - 1, min(_STRIP, len(rows))).round().astype(int)
    numbers = [row["number"] for row in (*worst, *(rows[step] for step in steps))]
    pictures = _pictures(order, {number: report.files[number] for number in numbers})
    worst = [{**row, "picture": pictures.pop(row["number"])} for row in worst if row["number"] in pictures]
    strip = tuple(sorted(pictures.items()))
    return Summary(report.milliseconds, tuple(rows), tuple(worst), strip, tuple(warnings), unfinished)


def _described(records: Mapping[int, FrameRecord]) -> list[dict[str, Any]]:
    """Rows of the page, a frame each; ``score`` is the smaller one of its changes from both neighbours."""
    rows: list[dict[str, Any]] = []
    for number, each in records.items():
        sides = [records[n].change for n in (number, number + 1) if n in records]
        rows.append(
            {
                "number": number,
                "change": each.change,
                "history": each.report.history,
                "reset": each.report.reset,
                "replaced_pixels": each.report.replaced_pixels,
                "milliseconds": sum(each.report.milliseconds.values()),
                "score": min((change for change in sides if change is not None), default=0.0),
            }
        )
    return rows


def _pictures(order: Order, files: Mapping[int, Path]) -> dict[int, str]:
    """Write thumbnails of frames; their paths relative to the page, by number of the frame."""
    shown = Preview(order.out / PICTURES / order.shot.name, video=False)
    found = {}
    for number, path in files.items():
        with suppress(InputError):
            image, metadata = open_result(path).read()
            shown.add(f"{number}", _shrunk(image, _THUMBNAIL), metadata)
            found[number] = os.path.relpath(shown.written[-1], order.out)
    return found


@functools.lru_cache(1)
def open_order(order: Order) -> Opened:
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
    return Opened(Found(shot, tuple(sequence.numbers), unreadable, overlap), sequence, denoiser, described)


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


def _small(image: Tensor) -> Tensor:
    """A small image whose change from frame to frame is measured."""
    return torch.log1p(_shrunk(image.detach().float(), _SMALL).clamp(0, 1e16)).cpu()


def _shrunk(image: Tensor, side: int) -> Tensor:
    """An image of at most this side."""
    height, width = image.shape[-2:]
    scale = side / max(height, width, side)
    return F.adaptive_avg_pool2d(image, (max(1, round(height * scale)), max(1, round(width * scale))))


def _difference(one: Tensor, other: Tensor) -> float | None:
    if one.shape != other.shape:
        return None
    return float((one - other).abs().mean() / (one.mean() + other.mean()).clamp_min(1e-6))
