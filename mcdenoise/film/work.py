"""The tasks of a film: scan a shot, denoise a piece of it, and summarize it when all pieces have ended.

A task depends on its arguments and on the disk alone, so that any worker can run it, and retry it. Arguments and
answers are small: workers read and write the frames themselves.
"""

from __future__ import annotations

import functools
import os
import traceback
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.commit import source_commit
from mcdenoise.data import Sequence
from mcdenoise.data.exr import read_exr, write_exr
from mcdenoise.data.files import remove, sweep
from mcdenoise.data.images import Window
from mcdenoise.data.readers.opening import open_result
from mcdenoise.data.sequences import frame_numbers
from mcdenoise.denoiser import Denoiser
from mcdenoise.errors import InputError
from mcdenoise.film.manifest import PICTURES, Shot
from mcdenoise.film.pieces import Piece
from mcdenoise.film.record import Digests, FrameRecord, Journal, Stamp, digest_of, digest_text, read_records, stamp
from mcdenoise.folder import FrameError, check_apart, make_folder, new_report, write_frames, write_report
from mcdenoise.heap import keep_heap, return_heap
from mcdenoise.metrics import smape_linear
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
        joint: largest difference of a frame from that of the uncut shot, see
            :func:`mcdenoise.models.frames_remembered`.
        threads: of torch; ``None`` for its own choice.
    """

    shot: Shot
    out: Path
    joint: float
    threads: int | None = None

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
        warnings: of the reader.
    """

    shot: Shot
    numbers: tuple[int, ...]
    done: frozenset[int]
    unreadable: Mapping[int, str]
    overlap: int | None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Made:
    """The failures of :func:`make`.

    Args:
        failed: for each failed frame, by number, the reason.
        trace: traceback of a failure that the input did not cause.
    """

    failed: Mapping[int, str] = field(default_factory=dict)
    trace: str = ""


@dataclass(frozen=True)
class Summary:
    """The summary of a shot.

    Args:
        milliseconds: median run time of each stage.
        frames: for each frame ``number``, ``change``, ``history``, ``reset``, ``replaced_pixels`` and ``score``.
        joints: for each joint, by the number of the frame before it, the SMAPE between the two results of that frame:
            with the whole history, and with that of the overlap alone.
        pictures: paths of the thumbnails, by number of the frame, relative to the page.
        warnings: what is probably wrong, a line each.
        unfinished: the numbers of all other frames: those that failed, and those whose files have changed meanwhile.
    """

    milliseconds: Mapping[str, float]
    frames: tuple[Mapping[str, Any], ...]
    joints: Mapping[int, float]
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
        self.opened, self.digests = opened, Digests()
        self._inputs: dict[int, tuple[tuple[Stamp, str], ...]] = {}

    def inputs(self, number: int) -> tuple[tuple[Stamp, str], ...]:
        """Stamps and digests of the files of a frame."""
        if number not in self._inputs:
            self._inputs[number] = tuple(self.digests.of(path) for path in self.opened.sequence.files(number))
        return self._inputs[number]

    def key(self, number: int) -> str:
        """The key of a frame: a digest of all that decides its result."""
        window = self.opened.window(number)
        key = digest_text(self.opened.settings, *(digest for each in window for _, digest in self.inputs(each)))
        # The next frames are added in another thread.
        for each in [each for each in list(self._inputs) if each < window[0]]:
            del self._inputs[each]
        return key

    def finished(self, order: Order) -> dict[int, FrameRecord]:
        """The records of the finished frames: whose results, inputs and settings are still those of the record."""
        records = read_records(order.records)
        self.digests.learn(records.values())
        numbers = [n for n in self.opened.sequence.numbers if n in records and order.has(records[n])]
        return {n: records[n] for n in numbers if records[n].key == self.key(n)}


def scan(order: Order) -> Found:
    """A task: find the frames of a shot, and which of them are finished.

    Raises:
        InputError: the shot cannot be opened, or cannot be denoised with these settings.
    """
    opened = _opened(order)
    done = _Keys(opened).finished(order)
    return Found(
        opened.shot,
        tuple(opened.sequence.numbers),
        frozenset(done),
        opened.unreadable,
        opened.overlap,
        tuple(opened.sequence.warnings),
    )


def make(order: Order, piece: Piece, journal: Path) -> Made:
    """A task: denoise the frames of a piece, and record each as it is finished.

    Args:
        order: of the shot.
        piece: the frames.
        journal: path of a new journal for this attempt.

    Returns:
        The frames that failed. A damaged frame fails alone, and the history begins anew after it; where a result cannot
        be written, all frames that are left fail.

    Raises:
        InputError: as :func:`scan`.
    """
    opened = _opened(order)
    make_folder(order.folder)
    check_apart(opened.sequence, order.folder)
    # That file says that the shot is complete.
    remove(order.folder / "denoise.json")
    numbers, left, keys = list(piece.numbers), set(piece.wanted), _Keys(opened)
    failed: dict[int, str] = {}
    try:
        with Journal(journal).open() as own:
            while left:
                writer = _Writer(order, keys, own, piece.joint, left)
                try:
                    writer.write(numbers)
                except FrameError as error:
                    numbers = [number for number in numbers if number > error.number]
                    failed |= {number: str(error) for number in left & {error.number}}
                    left -= {number for number in left if number <= error.number}
    except InputError as error:
        failed |= dict.fromkeys(left, str(error))
    except Exception as error:  # of a user's model, or for lack of memory
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        return Made(failed | dict.fromkeys(left, reason[:500]), traceback.format_exc())
    return Made(failed)


def summarize(order: Order) -> Summary:
    """A task: write ``denoise.json`` of a complete shot, its thumbnails and its preview, and measure its joints.

    Raises:
        InputError: as :func:`scan`, or something cannot be written.
    """
    opened = _opened(order)
    found = _Keys(opened).finished(order)
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
    joints = _joints(order, records, opened.sequence.window)
    described = _described(records)
    warnings = [*opened.sequence.warnings, *report.warnings] if records else list(opened.sequence.warnings)
    for number, difference in joints.items():
        if difference > order.joint:
            warnings.append(
                f"joint: the result of frame {number} differs by {difference:.2g} from that with a shorter history, "
                f"more than {order.joint:g}; make --piece longer, or 0 to cut nothing"
            )
    return Summary(
        report.milliseconds if records else {},
        tuple(described),
        joints,
        _pictures(order, records, described),
        tuple(warnings),
        unfinished,
    )


class _Writer:
    """Denoises frames, and records each as it is finished."""

    def __init__(self, order: Order, keys: _Keys, journal: Journal, joint: int | None, left: set[int]) -> None:
        self.order, self.keys, self.journal, self.joint, self.left = order, keys, journal, joint, left
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
        if number == self.joint:
            self._keep_joint(number, image)
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

    def _keep_joint(self, number: int, image: Tensor) -> None:
        """Keep the result before the joint, for :func:`summarize` to compare with that of the other piece."""
        pixels = image[0].permute(1, 2, 0).float().cpu().numpy()
        write_exr(_joint_path(self.order, number), pixels, ["R", "G", "B"], full_float=True)


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


def _joint_path(order: Order, number: int) -> Path:
    return order.records / f"joint{number}.exr"


def _joints(order: Order, records: Collection[FrameRecord], window: Window | None) -> dict[int, float]:
    """The SMAPE between the two results of the frame before each joint."""
    found = {}
    for record in records:
        path = _joint_path(order, record.number)
        if not path.is_file():
            continue
        try:
            shown = open_result(order.result(record)).read(window)[0]
            other = torch.from_numpy(np.ascontiguousarray(read_exr(path)[0][..., :3])).permute(2, 0, 1)[None]
        except InputError:
            continue
        if shown.shape == other.shape:
            found[record.number] = float(smape_linear(shown, other))
    return found


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
