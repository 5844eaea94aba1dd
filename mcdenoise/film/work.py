"""What a process does for a film: it looks at a shot, makes a piece of it, and closes it when all is made.

Each task is a function of what it is told and of the disk, so that any process on any machine can do it, again if need
be. It is told little and answers little: frames are read and written here, and go nowhere else.
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

# Where records are kept, beside the shots.
RECORDS = ".film"
# Settings that change no pixel.
_SILENT = {"frames", "threads", "preview", "preview_fps", "preview_exposure", "results", "max_memory"}
# Largest side of what is compared to see whether a frame sticks out, and of a thumbnail; how many of these a shot has.
_SMALL, _THUMBNAIL, _STRIP, _WORST = 64, 320, 6, 3


@dataclass(frozen=True)
class Order:
    """What every task is told.

    Args:
        shot: which.
        out: absolute folder of the film.
        joint: how far a frame may differ from that of the uncut shot, see :func:`mcdenoise.models.frames_remembered`.
        threads: of torch; ``None`` for its own choice.
    """

    shot: Shot
    out: Path
    joint: float
    threads: int | None = None

    @property
    def folder(self) -> Path:
        """Where the frames are written."""
        return self.out / self.shot.name

    @property
    def records(self) -> Path:
        """Where it is written down what is finished."""
        return self.out / RECORDS / self.shot.name

    def result(self, record: FrameRecord) -> Path:
        """The file of a finished frame, wherever the film has been moved to."""
        return self.folder / record.result[0]

    def has(self, record: FrameRecord) -> bool:
        """Whether that file is there, as it was written."""
        try:
            return stamp(self.result(record))[1:] == record.result[1:]
        except OSError:
            return False


@dataclass(frozen=True)
class Found:
    """What :func:`look` has found.

    Args:
        shot: with the model that was chosen, if a measurement chooses it.
        numbers: of all frames.
        done: those that are finished.
        unreadable: why, of frames that cannot be opened, by number.
        overlap: frames that the history needs, see :func:`mcdenoise.models.frames_remembered`.
        choice: the model that was chosen, in words.
        warnings: of the reader.
    """

    shot: Shot
    numbers: tuple[int, ...]
    done: frozenset[int]
    unreadable: Mapping[int, str]
    overlap: int | None
    choice: str = ""
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Made:
    """What :func:`make` did not make.

    Args:
        failed: why, by number of the frame.
        trace: where it went wrong, if it was no fault of the input.
    """

    failed: Mapping[int, str] = field(default_factory=dict)
    trace: str = ""


@dataclass(frozen=True)
class Closed:
    """What there is to say of a shot.

    Args:
        milliseconds: median of each stage.
        frames: of each frame the number, and ``change``, ``history``, ``reset``, ``replaced_pixels``, ``score``.
        joints: by the number of the frame before it, how far the two results of that frame differ: the one that stands,
            and the one with no more history than the pieces share.
        pictures: of the numbers of some frames, the thumbnails, beside the page.
        warnings: what is probably wrong.
    """

    milliseconds: Mapping[str, float]
    frames: tuple[Mapping[str, Any], ...]
    joints: Mapping[int, float]
    pictures: Mapping[int, str]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class _Opened:
    """A shot that is ready to be denoised."""

    shot: Shot
    sequence: Sequence
    denoiser: Denoiser
    overlap: int | None
    unreadable: Mapping[int, str]
    choice: str
    settings: str

    def window(self, number: int) -> list[int]:
        """The frame, and those before it that it remembers."""
        place = self.sequence.numbers.index(number)
        first = 0 if self.overlap is None else max(0, place - self.overlap)
        return self.sequence.numbers[first : place + 1]


class _Keys:
    """What frames are made of; frames are asked for in ascending order, and each file is looked at once.

    Args:
        opened: the shot.
        digests: of its files.
    """

    def __init__(self, opened: _Opened, digests: Digests) -> None:
        self.opened, self.digests = opened, digests
        self._inputs: dict[int, tuple[tuple[Stamp, str], ...]] = {}

    def inputs(self, number: int) -> tuple[tuple[Stamp, str], ...]:
        """The files of a frame, with digests."""
        if number not in self._inputs:
            self._inputs[number] = tuple(self.digests.of(path) for path in self.opened.sequence.files(number))
        return self._inputs[number]

    def key(self, number: int) -> str:
        """Of a frame: what it is made of, and what it remembers."""
        window = self.opened.window(number)
        key = digest_text(self.opened.settings, *(digest for each in window for _, digest in self.inputs(each)))
        self._inputs = {each: found for each, found in self._inputs.items() if each >= window[0]}
        return key


def look(order: Order) -> Found:
    """See which frames a shot has, and which of them are finished.

    Raises:
        InputError: the shot cannot be opened, or not be denoised in this way.
    """
    opened = _opened(order)
    records, digests = read_records(order.records), Digests()
    digests.learn(records.values())
    keys = _Keys(opened, digests)
    done = {
        number
        for number in opened.sequence.numbers
        if number in records and order.has(records[number]) and records[number].key == keys.key(number)
    }
    return Found(
        opened.shot,
        tuple(opened.sequence.numbers),
        frozenset(done),
        opened.unreadable,
        opened.overlap,
        opened.choice,
        tuple(opened.sequence.warnings),
    )


def make(order: Order, piece: Piece, journal: Path) -> Made:
    """Make the frames of a piece, and write down each as it is finished.

    Args:
        order: what every task is told.
        piece: which frames.
        journal: where; nobody else may write to it, and nobody may have.

    Returns:
        Which frames failed. A damaged frame fails alone, and the history begins anew behind it; where results cannot be
        written, all fail that are left.

    Raises:
        InputError: as :func:`look`.
    """
    opened = _opened(order)
    make_folder(order.folder)
    check_apart(opened.sequence, order.folder)
    # It stands for a complete result.
    remove(order.folder / "denoise.json")
    numbers, left = list(piece.numbers), set(piece.wanted)
    failed: dict[int, str] = {}
    try:
        with Journal(journal).open() as own:
            while left:
                writer = _Writer(order, opened, own, piece.joint, left)
                try:
                    writer.write(numbers)
                except FrameError as error:
                    numbers = [number for number in numbers if number > error.number]
                    failed |= {number: str(error) for number in left & {error.number}}
                    left -= {number for number in left if number <= error.number}
    except InputError as error:
        failed |= dict.fromkeys(left, str(error))
    except Exception as error:  # a model of somebody's own, or memory
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        return Made(failed | dict.fromkeys(left, reason[:500]), traceback.format_exc())
    return Made(failed)


def close(order: Order) -> Closed:
    """Sum up what was made of a shot: its ``denoise.json`` if it is complete, its thumbnails and preview.

    Raises:
        InputError: as :func:`look`, or something cannot be written.
    """
    opened = _opened(order)
    found = read_records(order.records)
    records = [found[n] for n in opened.sequence.numbers if n in found and order.has(found[n])]
    report = new_report(opened.sequence, _name(opened.shot))
    report.frames = {each.number: each.report for each in records}
    report.files = {each.number: order.result(each) for each in records}
    report.alike = [each.number for each in records if each.alike]
    for folder in (order.folder, order.records):
        sweep(folder, youngest=0)
    whole = len(records) == len(opened.sequence.numbers) and not opened.unreadable
    if whole:
        write_report(opened.sequence, order.folder, opened.denoiser, report)
        if opened.shot.settings.preview:
            _preview(order, opened, report.files)
    joints = _joints(order, records)
    described = _described(records)
    warnings = [*opened.sequence.warnings, *report.warnings] if records else list(opened.sequence.warnings)
    for number, difference in joints.items():
        if difference > order.joint:
            warnings.append(
                f"joint: the result of frame {number} differs by {difference:.2g} from that with a shorter history, "
                f"more than {order.joint:g}; make --piece longer, or 0 to cut nothing"
            )
    return Closed(
        report.milliseconds if records else {},
        tuple(described),
        joints,
        _pictures(order, records, described),
        tuple(warnings),
    )


class _Writer:
    """Makes frames, and writes down each as it is finished."""

    def __init__(self, order: Order, opened: _Opened, journal: Journal, joint: int | None, left: set[int]) -> None:
        self.order, self.opened, self.journal, self.joint, self.left = order, opened, journal, joint, left
        self.keys = _Keys(opened, Digests())
        self.report = new_report(opened.sequence, "")
        self.small: Tensor | None = None

    def write(self, numbers: list[int]) -> None:
        """Go through frames, of which those that are left are written."""
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
            on_file=self.finished,
        )

    def finished(self, number: int, image: Tensor) -> None:
        """In the thread that writes: the file of a frame is there."""
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
        """For :func:`close`, when the other piece has made this frame too."""
        pixels = image[0].permute(1, 2, 0).float().cpu().numpy()
        write_exr(_joint_path(self.order, number), pixels, ["R", "G", "B"], half=False)


@functools.lru_cache(1)
def _opened(order: Order) -> _Opened:
    """A shot, ready to be denoised; the last one is kept, of which a process may make several pieces."""
    keep_heap()
    if order.shot.settings.max_memory is not None:
        return_heap()
    threads = order.shot.settings.threads or order.threads
    if threads is not None:
        torch.set_num_threads(threads)
    sequence, unreadable = _open_what_opens(order.shot)
    settings, choice = order.shot.settings.chosen(sequence)
    denoiser = _denoiser(replace(settings, frames=None))
    denoiser.reset(frames=len(sequence))
    streams = len(sequence) > 1 and denoiser.has_history(sequence.buffers)
    overlap = frames_remembered(denoiser.model, order.joint) if streams else 0
    told = {key: str(value) for key, value in asdict(settings).items() if key not in _SILENT}
    # References change no result.
    rows = [str(row) for row in sequence.table if row.buffer != "reference"]
    described = digest_text(
        version("mcdenoise"), source_commit(), repr(sorted(told.items())), *_weights(settings), *rows, str(overlap)
    )
    shot = replace(order.shot, settings=settings)
    return _Opened(shot, sequence, denoiser, overlap, unreadable, choice, described)


@functools.lru_cache(1)
def _denoiser(settings: Any) -> Denoiser:
    denoiser: Denoiser = settings.denoiser()
    return denoiser


def _open_what_opens(shot: Shot) -> tuple[Sequence, dict[int, str]]:
    """The frames that can be opened, and why others cannot: one damaged file costs a film one frame."""
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
    """Digests of the files that the model is made of."""
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
    """What is compared to see whether a frame sticks out."""
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


def _joints(order: Order, records: Collection[FrameRecord]) -> dict[int, float]:
    """How far the two results of the frame before each piece differ."""
    found = {}
    for record in records:
        path = _joint_path(order, record.number)
        if not path.is_file():
            continue
        try:
            shown = open_result(order.result(record)).read()[0]
            other = torch.from_numpy(np.ascontiguousarray(read_exr(path)[0][..., :3])).permute(2, 0, 1)[None]
        except InputError:
            continue
        if shown.shape == other.shape:
            found[record.number] = float(smape_linear(shown, other))
    return found


def _described(records: Collection[FrameRecord]) -> list[dict[str, Any]]:
    """What the page says of each frame; ``score`` is how far it sticks out of both its neighbours."""
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
    """Thumbnails of the frames that stick out most, and of some of all."""
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
    """As `mcdenoise denoise --preview`, of the files: frames may have been made in any order."""
    settings = opened.shot.settings
    shown = Preview(
        order.folder,
        video=len(files) > 1,
        frames_per_second=settings.preview_fps,
        exposure=settings.preview_exposure,
    )
    for path in files.values():
        image, metadata = open_result(path).read()
        shown.add(path.stem, image, metadata)
    shown.close()
