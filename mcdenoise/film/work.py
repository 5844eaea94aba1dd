"""The tasks of a film: look at a shot, and denoise a piece of it.

A task depends on its arguments and on the disk alone, so that any worker can run it, and retry it. Arguments and
answers are small: workers read and write the frames themselves.

Each finished frame has a record, ``OUT/.film/SHOT/NUMBER.json``, by which the next run knows that it need not be
denoised again. Its key is a digest of all that decides the result: the files of the frame and of those in its history,
the settings, the weights and the version. A file has changed if its size or the time of its last change is another.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from mcdenoise.commit import source_commit
from mcdenoise.data import Sequence
from mcdenoise.data.files import make_folder, remove, write_text
from mcdenoise.data.readers.opening import Result, open_result
from mcdenoise.data.sequences import frame_numbers
from mcdenoise.denoiser import Denoiser
from mcdenoise.errors import InputError
from mcdenoise.film.manifest import PICTURES, RECORDS, Shot
from mcdenoise.folder import FrameError, prepare_folder, write_frames, write_report
from mcdenoise.heap import keep_heap, return_heap
from mcdenoise.models._report import FrameReport
from mcdenoise.models._weights import find_weights
from mcdenoise.models._wrapper import frames_remembered
from mcdenoise.preview import Preview
from mcdenoise.reading import read_bytes
from mcdenoise.sequence_report import SequenceReport
from mcdenoise.shot import ShotSettings

# Largest difference of a frame from that of the uncut shot, as a fraction; it decides where a piece begins.
_JOINT = 1e-2
# Settings that change no pixel of a result.
_SILENT = {"frames", "threads", "preview", "preview_fps", "preview_exposure", "results", "max_memory"}
# Thumbnails of a shot, and their largest side.
_PICTURES, _SIDE = 6, 320

# Numbers of the frames that one worker denoises, one after the other; and of those that it writes, the last of them.
Piece = tuple[tuple[int, ...], tuple[int, ...]]


@dataclass(frozen=True)
class FrameRecord:
    """The record of a finished frame.

    Args:
        key: digest of all that decides its result.
        file: name of the file that was written, in the folder of the shot.
        stamp: its size, and the time of its last change, which a moved file keeps.
        report: of the denoiser.
        alike: whether the frame resembles the frame before, and yet finds no history in it.
    """

    key: str
    file: str
    stamp: tuple[int, int]
    report: FrameReport
    alike: bool


@dataclass(frozen=True)
class Found:
    """What :func:`look` has found.

    Args:
        shot: the shot, with the model that limits have picked, if there are any.
        numbers: numbers of all frames.
        unreadable: for each frame that cannot be opened, by number, the reason.
        overlap: number of frames that the history needs; ``None`` if it has no known length.
        missing: numbers of the frames that are not finished.
        pictures: paths of thumbnails relative to OUT, by number of the frame.
        warnings: what is probably wrong, a line each.
    """

    shot: Shot
    numbers: tuple[int, ...]
    unreadable: dict[int, str]
    overlap: int | None
    missing: frozenset[int] = frozenset()
    pictures: tuple[tuple[int, str], ...] = ()
    warnings: tuple[str, ...] = ()

    def pieces(self, length: int) -> list[Piece]:
        """Cut the shot into pieces of equal length, and return those of which frames are missing.

        The boundaries depend on the shot alone. A piece begins ``overlap`` frames before the first that it writes.

        Args:
            length: largest number of frames that a piece writes; 0 does not cut the shot, nor does a history without a
                known length.

        Example:
            >>> shot = Found(Shot("a", (), ShotSettings()), tuple(range(6)), {}, 1, missing=frozenset({2, 3, 4}))
            >>> shot.pieces(3)
            [((0, 1, 2), (0, 1, 2)), ((2, 3, 4, 5), (3, 4, 5))]
        """
        count = 1 if self.overlap is None or length < 1 else -(-len(self.numbers) // length)
        cuts = pairwise(len(self.numbers) * part // count for part in range(count + 1))
        pieces = [(self.numbers[max(0, i - (self.overlap or 0)) : j], self.numbers[i:j]) for i, j in cuts]
        return [piece for piece in pieces if self.missing.intersection(piece[1])]


@dataclass(frozen=True)
class Opened:
    """A shot with its frames opened, its denoiser, its folders, and a digest of all settings that decide a result."""

    found: Found
    sequence: Sequence
    denoiser: Denoiser
    folder: Path
    records: Path
    settings: str

    def keys(self, numbers: Iterable[int]) -> dict[int, str]:
        """The keys of frames as their files are now."""
        everything, overlap = self.found.numbers, self.found.overlap
        stamps = functools.cache(lambda number: [_stamp(path) for path in self.sequence.files(number)])
        keys = {}
        for number in numbers:
            place = everything.index(number)
            window = everything[0 if overlap is None else max(0, place - overlap) : place + 1]
            keys[number] = _digest(self.settings, *(stamp for each in window for stamp in stamps(each)))
        return keys

    def finished(self, keys: dict[int, str]) -> dict[int, FrameRecord]:
        """The records of those frames that have these keys, and whose results are as they were written."""
        found: dict[int, FrameRecord] = {}
        for number, key in keys.items():
            # A record that is missing or damaged is none: its frame is made again.
            with suppress(OSError, ValueError, RecursionError):
                record = msgspec.json.decode(read_bytes(self.records / f"{number}.json"), type=FrameRecord)
                status = os.stat(self.folder / record.file)
                if record.key == key and record.stamp == (status.st_size, status.st_mtime_ns):
                    found[number] = record
        return found


def look(shot: Shot, out: Path) -> Found:
    """A task: find the frames of a shot, and which of them are finished; records of the others are removed.

    If all are, ``denoise.json`` and the preview are written.

    Raises:
        InputError: the shot cannot be opened, or cannot be denoised with these settings; or something cannot be
            written.
    """
    opened = open_shot(shot, out)
    found, sequence = opened.found, opened.sequence
    records = opened.finished(opened.keys(found.numbers))
    missing = frozenset(found.numbers) - records.keys()
    for number in missing:
        remove(opened.records / f"{number}.json")
    settings, spelling = found.shot.settings, found.shot.settings.spelling
    report = SequenceReport(
        str(spelling.weights or spelling.name),
        sequence.color_has_albedo,
        found.shot.picked,
        frames={number: each.report for number, each in records.items()},
        files={number: opened.folder / each.file for number, each in records.items()},
        alike=[number for number, each in records.items() if each.alike],
    )
    if not missing and not found.unreadable:
        write_report(sequence, opened.folder, opened.denoiser, report)
        if settings.preview:
            # From the files, since frames were denoised in any order.
            shown = settings.preview_in(opened.folder, video=len(records) > 1)
            for path in report.files.values():
                result = _result(path, settings)
                shown.add(path.stem, result.read(sequence.window), result.metadata)
            shown.close()
    warnings = (*sequence.warnings, *(report.warnings if records else []))
    return replace(found, missing=missing, pictures=tuple(_pictures(out, found.shot, report.files)), warnings=warnings)


def _result(path: Path, settings: ShotSettings) -> Result:
    """The denoised radiance in a file that was written with these settings."""
    return open_result(path, settings.output_layer, "linear" if settings.input_linear else "auto")


def _pictures(out: Path, shot: Shot, files: dict[int, Path]) -> Iterable[tuple[int, str]]:
    """Write thumbnails of some frames across the shot."""
    numbers, shown = list(files), Preview(out / PICTURES / shot.name, video=False)
    for place in np.linspace(0, len(numbers) - 1, min(_PICTURES, len(numbers))).round().astype(int):
        # A picture that cannot be made is missing on the page, and nothing else.
        with suppress(InputError):
            result = _result(files[numbers[place]], shot.settings)
            small = avg_pool2d(result.read(), -(-max(result.size) // _SIDE), ceil_mode=True)
            shown.add(f"{numbers[place]}", small, result.metadata)
            yield numbers[place], os.path.relpath(shown.written[-1], out)


def make(shot: Shot, out: Path, piece: Piece) -> dict[int, str]:
    """A task: denoise the frames of a piece that are not finished, and record each as it is.

    They are computed from the beginning of the piece, so that it does not matter whether it was interrupted.

    Returns:
        For each damaged frame, by number, the reason. It fails alone, and the history begins anew after it.

    Raises:
        InputError: as :func:`look`, or a result cannot be written.
    """
    opened, (numbers, written) = open_shot(shot, out), piece
    prepare_folder(opened.sequence, opened.folder)
    make_folder(opened.records)
    # Before the frames are read: if a file changes later, its frame has another key, and so is not finished.
    keys = opened.keys(written)
    left = set(written) - opened.finished(keys).keys()
    last = max(left, default=-1)
    numbers = tuple(number for number in numbers if number in left or (opened.found.overlap != 0 and number < last))
    failed: dict[int, str] = {}
    while left.intersection(numbers):
        try:
            _write(opened, numbers, left, keys)
        except FrameError as error:
            numbers = tuple(number for number in numbers if number > error.number)
            failed |= {number: str(error) for number in left & {error.number}}
            left -= {error.number}
    return failed


def _write(opened: Opened, numbers: tuple[int, ...], left: set[int], keys: dict[int, str]) -> None:
    """Denoise frames, write those that are left, and record each as it is finished, which takes it from them."""
    report = SequenceReport("", opened.sequence.color_has_albedo)

    def finished(number: int, image: Tensor) -> None:
        """Called in the thread that has written the file."""
        done = report.frames.pop(number)
        if number in left:
            status = os.stat(path := report.files.pop(number))
            stamp = status.st_size, status.st_mtime_ns
            record = FrameRecord(keys[number], path.name, stamp, done, number in report.alike)
            write_text(opened.records / f"{number}.json", msgspec.json.encode(record).decode())
            left.discard(number)

    write_frames(
        opened.sequence.part(numbers),
        opened.folder,
        opened.denoiser,
        report,
        full_float=opened.found.shot.settings.full_float,
        output_layer=opened.found.shot.settings.output_layer,
        unwritten=[number for number in numbers if number not in left],
        of=len(opened.sequence),
        on_file=finished,
    )


@functools.lru_cache(1)
def open_shot(shot: Shot, out: Path) -> Opened:
    """Open a shot; the last one is cached, because a worker may denoise several pieces of it."""
    keep_heap()
    if shot.settings.max_memory is not None:
        return_heap()
    if shot.settings.threads is not None:
        torch.set_num_threads(shot.settings.threads)
    sequence, unreadable = _open_what_opens(shot)
    settings, choice = shot.settings.chosen(sequence)
    # Digested first: if a file changes while it is read, the frames belong to a digest that no file has.
    files = [hashlib.sha256(path.read_bytes()).hexdigest() for path in _files_of_model(settings)]
    denoiser = settings.denoiser()
    denoiser.reset(frames=len(sequence))
    streams = len(sequence) > 1 and denoiser.has_history(sequence.buffers)
    overlap = frames_remembered(denoiser.model, _JOINT) if streams else 0
    listed = sorted((key, str(value)) for key, value in asdict(settings).items() if key not in _SILENT)
    # References do not change a result.
    rows = [str(row) for row in sequence.table if row.buffer != "reference"]
    digest = _digest(version("mcdenoise"), source_commit(), repr(listed), *files, *rows, str(overlap))
    # Later the model is named, and the reason is that of the first look.
    shot = replace(shot, settings=settings, picked=choice or shot.picked)
    found = Found(shot, tuple(sequence.numbers), unreadable, overlap)
    return Opened(found, sequence, denoiser, out / shot.name, out / RECORDS / shot.name, digest)


def _open_what_opens(shot: Shot) -> tuple[Sequence, dict[int, str]]:
    """Open all frames that can be opened, with the reasons of the others: a damaged file costs a film one frame."""
    settings = shot.settings
    try:
        return settings.open(shot.inputs), {}
    except InputError:
        refused: dict[int, str] = {}
        numbers = frame_numbers(shot.inputs, settings.frames)
        for number in numbers:
            try:
                replace(settings, frames=str(number)).open(shot.inputs)
            except InputError as error:
                refused[number] = str(error)
        good = [str(number) for number in numbers if number not in refused]
        if not good or not refused:
            raise
        return replace(settings, frames=",".join(good)).open(shot.inputs), refused


def _files_of_model(settings: ShotSettings) -> list[Path]:
    """The model's weights, or its source if it is the user's."""
    spelling = settings.spelling
    paths = [spelling.weights, Path(spelling.model.rpartition(":")[0]) if ".py:" in spelling.model else None]
    if not any(paths) and ":" not in spelling.model:
        paths = [find_weights(spelling.model)]
    return [path for path in paths if path is not None]


def _stamp(path: Path) -> str:
    """Name and size of a file, and time of its last change; zeros where there is no such file."""
    with suppress(OSError):
        status = os.stat(path)
        # A copy may keep the time of its source, but not that of the last change of its entry.
        return f"{path.name} {status.st_size} {max(status.st_mtime_ns, status.st_ctime_ns)}"
    return f"{path.name} 0 0"


def _digest(*parts: str) -> str:
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()
