"""The tasks of a film: scan a shot, and denoise a piece of it; `summary` has the last one.

A task depends on its arguments and on the disk alone, so that any worker can run it, and retry it. Arguments and
answers are small: workers read and write the frames themselves.
"""

from __future__ import annotations

import functools
import secrets
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, BinaryIO

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.commit import source_commit
from mcdenoise.data import Sequence
from mcdenoise.data.files import make_folder, remove
from mcdenoise.data.sequences import frame_numbers
from mcdenoise.denoiser import Denoiser
from mcdenoise.engines import describe_error
from mcdenoise.errors import InputError
from mcdenoise.film.manifest import Shot
from mcdenoise.film.pieces import Piece, cut
from mcdenoise.film.record import (
    FrameRecord,
    Stamp,
    digest_of,
    digest_text,
    read_records,
    stamp,
    stamp_and_digest,
    write_record,
)
from mcdenoise.folder import FrameError, check_apart, new_report, write_frames
from mcdenoise.heap import keep_heap, return_heap
from mcdenoise.models import find_weights, frames_remembered

# Folder of the records, beside the shots.
RECORDS = ".film"
# Settings that change no pixel of a result.
_SILENT = {"frames", "threads", "preview", "preview_fps", "preview_exposure", "results", "max_memory"}
# Largest side of the images whose change is measured.
_SMALL = 64


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
class Opened:
    """A shot with its frames opened, and its denoiser."""

    shot: Shot
    sequence: Sequence
    denoiser: Denoiser
    overlap: int | None
    unreadable: Mapping[int, str]
    settings: str


class Keys:
    """Keys of frames. Frames are asked for in ascending order, so that each file is read at most once.

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
            self._inputs[number] = tuple(
                stamp_and_digest(path, self._recorded) for path in self.opened.sequence.files(number)
            )
        return self._inputs[number]

    def key(self, number: int) -> str:
        """The key of a frame: a digest of all that decides its result."""
        numbers, overlap = self.opened.sequence.numbers, self.opened.overlap
        place = numbers.index(number)
        # The frame, and the frames in its history.
        window = numbers[0 if overlap is None else max(0, place - overlap) : place + 1]
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
    opened = open_order(order)
    numbers = tuple(opened.sequence.numbers)
    done = frozenset(Keys(opened).finished(order, numbers))
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
            for part in cut(piece.numbers, left, 0, opened.overlap):
                numbers, keys = list(part.numbers), Keys(opened)
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


class _Writer:
    """Denoises frames, and records each as it is finished."""

    def __init__(self, order: Order, keys: Keys, journal: BinaryIO, left: set[int]) -> None:
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
        write_record(self.journal, record)
        self.left.discard(number)


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
    return Opened(shot, sequence, denoiser, overlap, unreadable, described)


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
    height, width = image.shape[-2:]
    scale = _SMALL / max(height, width, _SMALL)
    size = (max(1, round(height * scale)), max(1, round(width * scale)))
    return torch.log1p(F.adaptive_avg_pool2d(image.detach().float(), size).clamp(0, 1e16)).cpu()


def _difference(one: Tensor, other: Tensor) -> float | None:
    if one.shape != other.shape:
        return None
    return float((one - other).abs().mean() / (one.mean() + other.mean()).clamp_min(1e-6))
