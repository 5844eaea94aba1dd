"""Denoising the files of a shot to files of the same names, with a report of skipped work and run times."""

from __future__ import annotations

import os
import re
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import partial
from importlib.metadata import version
from itertools import zip_longest
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.data import Sequence
from mcdenoise.data.files import check_writable, listed, make_folder, remove, write_json
from mcdenoise.data.images import Image, Metadata
from mcdenoise.data.readers.diffuse_specular import LIGHT_PARTS
from mcdenoise.denoiser import Denoiser
from mcdenoise.errors import InputError
from mcdenoise.frame import Frame, tells_motion
from mcdenoise.models import Output, Skipping
from mcdenoise.models._report import FrameReport
from mcdenoise.models._wrapper import parts_of
from mcdenoise.sequence_report import SequenceReport

# Largest fraction of pixels without a history, and smallest correlation of two images of the same place.
_MOST, _ALIKE = 0.5, 0.9
_NUMBERS = re.compile("[0-9]+")


class FrameError(InputError):
    """A frame cannot be denoised: one of its files is damaged, or its contents are invalid.

    Args:
        message: one line.
        number: number of the frame.
    """

    def __init__(self, message: str, number: int) -> None:
        super().__init__(message)
        self.number = number


def denoise_sequence(
    sequence: Sequence,
    out: Path,
    denoiser: Denoiser,
    model: str,
    *,
    full_float: bool = False,
    output_layer: str | None = None,
    picked: str = "",
    on_frame: Callable[[], None] = lambda: None,
    on_written: Callable[[str, Tensor, Metadata], None] | None = None,
) -> SequenceReport:
    """Denoise a sequence, and write its files (:meth:`mcdenoise.data.Sequence.write`) and ``OUT/denoise.json``.

    While a frame is denoised, the next one is read and the previous one is written, unless memory is limited
    (``Denoiser(max_memory=...)``).

    Args:
        sequence: the frames.
        out: folder to write to; created if it does not exist.
        denoiser: the denoiser; it is reset first.
        model: name of the model in the report.
        full_float: write the radiance as 32-bit floats, whatever its type was before.
        output_layer: name of a layer to add; no layer is replaced then.
        picked: see :class:`SequenceReport`.
        on_frame: called after each denoised frame.
        on_written: called with the name of each written file without ``.exr``, its image ``(1, 3, H, W)`` and its
            metadata, in the order of the frames, in the writing thread; such as ``Preview.add``.

    Raises:
        InputError: a file is damaged, a buffer is missing or has invalid values, the result is not finite, the folder
            cannot be written to, or memory is insufficient. Frames before the one that the message names are written.
    """
    prepare_folder(sequence, out)
    report = SequenceReport(model, sequence.color_has_albedo, picked)
    write_frames(
        sequence,
        out,
        denoiser,
        report,
        full_float=full_float,
        output_layer=output_layer,
        on_frame=on_frame,
        on_file=on_written
        and (lambda number, image: on_written(report.files[number].stem, image, sequence.metadata(number))),
    )
    write_report(sequence, out, denoiser, report)
    return report


def write_frames(
    sequence: Sequence,
    out: Path,
    denoiser: Denoiser,
    report: SequenceReport,
    *,
    full_float: bool = False,
    output_layer: str | None = None,
    unwritten: Collection[int] = (),
    of: int | None = None,
    on_frame: Callable[[], None] = lambda: None,
    on_file: Callable[[int, Tensor], None] | None = None,
) -> None:
    """Denoise frames one after the other and write their files; :func:`denoise_sequence` does this for a whole shot.

    Args:
        sequence: the frames.
        out: existing folder to write to.
        denoiser: the denoiser; it is reset first.
        report: the report to fill in.
        full_float: see :func:`denoise_sequence`.
        output_layer: see :func:`denoise_sequence`.
        unwritten: frames that are denoised only to give the others their history; no files are written for them.
        of: number of frames of the whole shot, if these are its beginning; by default the shot ends with them.
        on_frame: see :func:`denoise_sequence`.
        on_file: called with the number and the image ``(1, 3, H, W)`` of each frame, in the writing thread, after its
            file has been written, if it gets one.

    Raises:
        FrameError: a frame is damaged, invalid or lacks a buffer, or its result is not finite; the frames before it are
            written.
        InputError: a file cannot be written, or memory is insufficient.
    """
    save = partial(sequence.write, out, output_layer=output_layer, full_float=full_float)
    with ThreadPoolExecutor(1) as writer:
        writing: Future[None] = writer.submit(lambda: None)
        seen: Tensor | None = None
        for number, frame, output in denoised_frames(sequence, denoiser, reference=False, of=of):
            seen, before = _thumbnail(frame), seen
            follows = tells_motion(frame.buffers) and not denoiser.report.repeats
            if follows and _finds_nothing(denoiser.report, frame) and _alike(seen, before):
                report.alike.append(number)
            del frame
            start = time.perf_counter()
            writing.result()
            report.frames[number] = denoiser.report
            kept = None if number in unwritten else save
            writing = writer.submit(_write, number, output, report, denoiser.report, kept, on_file)
            del output
            if not denoiser.has_room_ahead:
                writing.result()
            denoiser.report.milliseconds["waiting"] += _since(start)
            on_frame()
        writing.result()


def _write(
    number: int,
    output: Output,
    report: SequenceReport,
    done: FrameReport,
    save: Callable[..., Path] | None,
    on_file: Callable[[int, Tensor], None] | None,
) -> None:
    start = time.perf_counter()
    if save is not None:
        alpha = None if output.alpha is None else _pixels(output.alpha)
        lights = {name: _pixels(layer) for name, layer in output.layers.items()}
        report.files[number] = save(number, _pixels(output.image), alpha=alpha, lights=lights)
        done.beside["write"] = _since(start)
    if on_file is not None:
        start = time.perf_counter()
        on_file(number, output.image)
        done.beside["show"] = _since(start)


def write_report(sequence: Sequence, out: Path, denoiser: Denoiser, report: SequenceReport) -> None:
    """Write ``OUT/denoise.json``, which records that the result is complete, and how it was made.

    Raises:
        InputError: the file cannot be written.
    """
    report.older = _of_earlier_runs(out, report.files.values())
    content = {
        "model": report.model,
        "picked": report.picked,
        "versions": {name: version(name) for name in ("mcdenoise", "torch", "kornia")},
        "device": str(denoiser.device),
        "precision": denoiser.precision,
        "precision_reason": report.precision,
        "threads": torch.get_num_threads(),
        "sequence": {"name": sequence.name, "layout": sequence.layout, "size": list(sequence.size)},
        "read": [row._asdict() for row in sequence.table],
        "warnings": [*sequence.warnings, *report.warnings],
        "keep_all": denoiser.keep_all,
        "tolerance": next((skipping.tolerance for skipping in parts_of(denoiser.model, Skipping)), None),
        "plan": report.plan,
        "tiles": report.tiles,
        "reads_ahead": denoiser.has_room_ahead,
        "milliseconds": report.milliseconds,
        "beside": report.beside,
        "frames": {
            str(number): {
                "file": report.files[number].name,
                "milliseconds": done.milliseconds,
                "beside": done.beside,
                "reset": done.reset,
                "history": done.history,
                "replaced_pixels": done.replaced_pixels,
                "negative_light": done.repairs.negative,
                "light_gained": done.repairs.gained,
                "missing": done.missing,
            }
            for number, done in report.frames.items()
        },
    }
    write_json(out / "denoise.json", content)


def denoised_frames(
    sequence: Sequence,
    denoiser: Denoiser,
    *,
    reference: bool = True,
    of: int | None = None,
) -> Iterator[tuple[int, Frame, Output]]:
    """Denoise frame after frame, while the next one is read if memory allows.

    Args:
        sequence: the frames.
        denoiser: the denoiser; it is reset first.
        reference: also read references.
        of: see :func:`write_frames`.

    Yields:
        Number, frame and output; the denoiser's report includes the time of reading.

    Raises:
        FrameError: see :func:`write_frames`.
    """
    wanted, streaming = _begin(sequence, denoiser, reference, of or len(sequence))

    def read(number: int) -> tuple[Frame, float]:
        start = time.perf_counter()
        frame = sequence.frame(number, reference=reference, buffers=wanted)
        # Depth may be computed from the positions.
        return frame if streaming else frame.with_depth().without_history(), _since(start)

    def denoised(reading: Future[tuple[Frame, float]], number: int, waiting: float) -> tuple[int, Frame, Output]:
        try:
            frame, took = reading.result()
        except InputError as error:
            raise FrameError(str(error), number) from error
        try:
            output = denoiser.output(frame, stages=False)
        except InputError as error:
            raise FrameError(f"{sequence.root}, frame {number}: {error}", number) from error
        denoiser.report.milliseconds = {"waiting": waiting, **denoiser.report.milliseconds}
        denoiser.report.beside["read"] = took
        return number, frame, output

    with ThreadPoolExecutor(1) as reader:
        # Keep no reference to a frame here, so that the caller can free it.
        coming: deque[Future[tuple[Frame, float]]] = deque()
        for number, following in zip_longest(sequence.numbers, sequence.numbers[1:]):
            start = time.perf_counter()
            if not coming:
                coming.append(reader.submit(read, number))
            wait(coming)
            waiting = _since(start)
            if following is not None and denoiser.has_room_ahead and coming[0].exception() is None:
                coming.append(reader.submit(read, following))
            yield denoised(coming.popleft(), number, waiting)


def _begin(sequence: Sequence, denoiser: Denoiser, reference: bool, of: int) -> tuple[frozenset[str], bool]:
    """Reset the denoiser; return the buffers that it uses, and whether it has a history."""
    wanted = denoiser.model.needs.buffers | denoiser.model.needs.uses
    buffers = sequence.buffers - (set() if reference else {"reference"}) - (LIGHT_PARTS - wanted)
    denoiser.reset(buffers, of, sequence.size, len(sequence.lights))
    denoiser.frames_stay, denoiser.warns = True, False
    return wanted, denoiser.has_history(buffers)


def _pixels(image: Tensor) -> Image:
    """``(H, W, C)`` pixels of a batch of one."""
    pixels: Image = image[0].permute(1, 2, 0).float().cpu().numpy()
    return pixels


def _thumbnail(frame: Frame) -> Tensor:
    """A small image of the scene with little noise."""
    shown = torch.log1p(frame.color.nan_to_num(0, 0, 0).clamp(0, 1e3)) if frame.albedo is None else frame.albedo
    return F.adaptive_avg_pool2d(shown, (min(16, frame.size[0]), min(16, frame.size[1])))


def _finds_nothing(done: FrameReport, frame: Frame) -> bool:
    """Whether most pixels with a hit have no history. Pixels without a hit may have none."""
    hit = frame.color.amax(1) > 0 if frame.depth is None else frame.depth.isfinite()
    return done.history is not None and done.history < _MOST * float(hit.float().mean())


def _alike(one: Tensor, other: Tensor | None) -> bool:
    if other is None or one.shape != other.shape:
        return False
    return float(torch.corrcoef(torch.stack([one.flatten(), other.flatten()]))[0, 1]) > _ALIKE


def _since(start: float) -> float:
    return (time.perf_counter() - start) * 1e3


def prepare_folder(sequence: Sequence, out: Path) -> None:
    """Create the folder for the results of a sequence, or remove an old report from it.

    Raises:
        InputError: the results cannot be written there, or would overwrite inputs.
    """
    make_folder(out)
    check_apart(sequence, out)
    # A report stands for a complete result: remove an old one, in case this run fails.
    remove(out / "denoise.json")
    check_writable(out / "denoise.json")


def check_apart(sequence: Sequence, out: Path) -> None:
    """Raise an error if results, which have the names of the inputs, would overwrite inputs, also through a link."""
    inputs = {os.path.realpath(folder) for folder in (*sequence.folders, sequence.root)}
    # Inputs may themselves be links to files elsewhere.
    inputs |= {os.path.realpath(path) for folder in sequence.folders for path in listed(folder) if path.is_symlink()}
    if os.path.realpath(out) in inputs:
        raise InputError(
            f"{out}: expected another folder than that of the input, found the same; choose one to write to"
        )
    for path in listed(out):
        target = os.path.realpath(path)
        if (path.is_file() and target in inputs) or (path.is_symlink() and {target, os.path.dirname(target)} & inputs):
            raise InputError(
                f"{path}: expected no input, nor a link to an input, which would be written to, found one; choose "
                "another folder"
            )


def _of_earlier_runs(out: Path, written: Iterable[Path]) -> list[str]:
    """Names of files that differ from the written ones only in their numbers."""
    own = {path.name for path in written}
    kinds = {_NUMBERS.sub("#", name) for name in own}
    return sorted(name for name in os.listdir(out) if name not in own and _NUMBERS.sub("#", name) in kinds)
