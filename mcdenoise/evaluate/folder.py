"""Comparison of images, from a folder or from a method, with the references of their sequence."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mcdenoise.data import Sequence
from mcdenoise.data.color_space import to_rec709
from mcdenoise.data.readers.names import group_files
from mcdenoise.data.readers.opening import Result, open_result
from mcdenoise.denoiser import Denoiser
from mcdenoise.errors import InputError, naming
from mcdenoise.evaluate.noise import as_noisy, recorded_noise, reference_noise
from mcdenoise.evaluate.scores import METRICS, USUAL, Scores, check_references
from mcdenoise.folder import denoised_frames
from mcdenoise.frame import Frame
from mcdenoise.metrics import (
    PROTOCOLS,
    Flicker,
    Metric,
    UncomputableError,
    flip_hdr,
    warped_rmse_srgb,
    warping_error_srgb,
)
from mcdenoise.metrics.protocols import ProtocolName
from mcdenoise.models._history import motion_to_previous, surface_before
from mcdenoise.ops import Surface

STRICT: ProtocolName = "strict"
WARPED, FLICKER = "wRMSE", "flicker"
_METRICS = {**{name: METRICS[name] for name in USUAL}, "HDR-FLIP": Metric(flip_hdr)}
# Metrics by which the truth itself can be scored.
_OF_FLOOR = {name: METRICS[name] for name in USUAL if name not in ("RMSE", "FLIP")}
_OURS = re.compile(r"denoised\d+")
# Maximum motion, in pixels, of a shot that counts as static.
_STILL = 0.05


@dataclass
class Table(Scores):
    """Values of one protocol.

    Args:
        frames: see :class:`Scores`.
        skipped: see :class:`Scores`.
        description: how the protocol computes its values.
        shots: metrics of whole shots, with their number of frames.
    """

    description: str = ""
    shots: dict[str, tuple[float, int]] = field(default_factory=dict)

    @property
    def mean(self) -> dict[str, float]:
        """Mean over the frames, by metric, and the metrics of whole shots."""
        return super().mean | {name: value for name, (value, _) in self.shots.items()}

    @property
    def counts(self) -> dict[str, int]:
        """Number of frames in each mean."""
        frames = {name: len(own) for name, own in self.columns.items()}
        return frames | {name: count for name, (_, count) in self.shots.items()}


@dataclass
class Evaluation:
    """Errors of the images of a sequence.

    Args:
        sequence: its name.
        images: the folder, or the name of the method.
        tables: by protocol; ``"strict"`` is always included, with every metric.
        warping_error: warping error (Lai et al. 2018) of the images and of the references, mean over the pairs of
            frames.
        reference_noise: estimated SMAPE of the references themselves, if the renderer has recorded it.
        floor: score of a perfect result against references with that noise, by metric.
    """

    sequence: str
    images: Path | str
    tables: dict[ProtocolName, Table]
    warping_error: tuple[float, float] | None = None
    reference_noise: float | None = None
    floor: dict[str, float] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """The evaluation as JSON values, but for the PSNR of equal images, which is infinite."""
        tables = {
            name: {
                "description": table.description,
                "frames": {str(number): values for number, values in table.frames.items()},
                "mean": table.mean,
                "counts": table.counts,
                "skipped": table.skipped,
            }
            for name, table in self.tables.items()
        }
        ours, theirs = self.warping_error or (None, None)
        return {
            "sequence": self.sequence,
            "images": str(self.images),
            "protocols": tables,
            "warping_error": {"images": ours, "references": theirs},
            "reference_noise": self.reference_noise,
            "perfect": self.floor,
        }


def find_images(folder: Path, numbers: Collection[int]) -> dict[int, Path]:
    """Find the EXR file of each frame, by the number in its name; or the one file of one frame.

    If the folder has files ``denoisedN.exr``, only these are used. Otherwise the names of all its EXR files must differ
    in one number only, such as ``frame.0012.exr`` or ``shot02_0012.exr``; other numbers in the names must be constant.

    Args:
        folder: folder of the images; for one frame, its image.
        numbers: required frames.

    Raises:
        InputError: there is no such folder, the names do not give frame numbers, or a frame is missing.
    """
    if os.path.isfile(folder) and len(numbers) == 1:
        return dict.fromkeys(numbers, folder)
    if not os.path.isdir(folder):
        found = f"a file for {len(numbers)} frames" if os.path.isfile(folder) else "no such folder"
        raise InputError(f"{folder}: expected a folder of denoised EXR images, found {found}; check the path")
    paths = [path for path in sorted(folder.glob("*.exr")) if not path.name.startswith(".")]
    if not paths:
        raise InputError(f"{folder}: expected denoised EXR images, found none; check the path")
    (group, *others), _ = group_files([path for path in paths if _OURS.fullmatch(path.stem)] or paths)
    if others:
        shown = ", ".join(each.first.name for each in (group, others[-1]))
        raise InputError(
            f"{folder}: expected names that differ in one number, that of the frame, such as denoised12.exr or "
            f"frame.0012.exr, found {shown}; keep only one series of images in the folder"
        )
    files = group.files
    missing = [number for number in numbers if number not in files]
    if missing:
        raise InputError(
            f"{folder}: expected an image of every frame with a reference, found none of frame "
            f"{', '.join(map(str, missing[:8]))}{', ...' if len(missing) > 8 else ''} "
            f"(it has frames {min(files)} to {max(files)}); denoise all frames, or choose some with --frames"
        )
    return {number: files[number] for number in numbers}


def evaluate_folder(
    sequence: Sequence,
    folder: Path,
    *,
    protocol: ProtocolName = STRICT,
    on_frame: Callable[[int], None] = lambda number: None,
) -> Evaluation:
    """Compare the images of a folder with the references of a sequence.

    Temporal metrics use pairs of successive frames with references. Metrics along the motion need motion buffers, or
    positions with cameras; flicker needs shots without motion of more than 0.05 pixels.

    Args:
        sequence: frames with references.
        folder: folder with an EXR image of each frame, see :func:`find_images`: alone or among other layers,
            scene-linear, with the primaries of its header ``chromaticities``, or else of Rec. 709. The references have
            the primaries that the headers of the color files state.
        protocol: name in :data:`mcdenoise.metrics.PROTOCOLS`; its values are added to the strict ones.
        on_frame: called with the number of each finished frame.

    Raises:
        InputError: the sequence has no references; an image is missing, damaged, of another size, has other channels,
            or pixels that are not finite; or a buffer has invalid values.
    """
    check_references(sequence)
    files = open_images(folder, sequence, sequence.reference_numbers)
    images = ((number, *_read(sequence, number, found)) for number, found in files.items())
    return _evaluate(sequence, folder, images, protocol, on_frame)


def evaluate_method(
    sequence: Sequence,
    denoiser: Denoiser,
    name: str,
    *,
    protocol: ProtocolName = STRICT,
    on_frame: Callable[[int], None] = lambda number: None,
) -> Evaluation:
    """Denoise a sequence and compare the images with its references, without writing them; see :func:`evaluate_folder`.

    Args:
        sequence: frames with references; frames without one are denoised too, because the history needs them.
        denoiser: denoiser; it is reset first.
        name: name of the method, for the table.
        protocol: see :func:`evaluate_folder`.
        on_frame: called with the number of each finished frame, including frames without a reference.

    Raises:
        InputError: the sequence has no references, a file is damaged, or a buffer that the method needs is missing.
    """
    check_references(sequence)

    def images() -> Iterator[tuple[int, Tensor, Frame, Tensor]]:
        for number, frame, output in denoised_frames(sequence, denoiser):
            if frame.reference is None:
                on_frame(number)
                continue
            metadata = sequence.metadata(number)
            image, reference = (to_rec709(each, metadata) for each in (output.image.cpu(), frame.reference))
            yield number, image, frame.with_depth().validate()[0], reference

    return _evaluate(sequence, name, images(), protocol, on_frame)


@torch.no_grad()
def _evaluate(
    sequence: Sequence,
    source: Path | str,
    images: Iterable[tuple[int, Tensor, Frame, Tensor]],
    protocol: ProtocolName,
    on_frame: Callable[[int], None],
) -> Evaluation:
    """Evaluate images, each with its number, frame and reference."""
    tables = {name: Table(description=PROTOCOLS[name].description) for name in dict.fromkeys((STRICT, protocol))}
    pairs, floor, noise = _Pairs(tables[STRICT]), Scores(), recorded_noise(sequence)
    for number, image, frame, reference in images:
        for name, table in tables.items():
            if number in sequence.numbers[PROTOCOLS[name].skipped_frames :]:
                table.add(_metrics(name), number, image, reference)
        pairs.add(number, frame, image, reference)
        if number in noise:
            floor.add(_OF_FLOOR, number, reference, as_noisy(reference, noise[number], seed=number))
        on_frame(number)
    pairs.finish()
    for name, table in tables.items():
        reason = f"{name} skips {PROTOCOLS[name].skipped_frames} frames; this sequence has no reference after these"
        names = [*_metrics(name)]
        if table.frames:
            names = [metric for metric, each in _metrics(name).items() if each.temporal] + [WARPED] * (name == STRICT)
            reason = "no two successive frames with references"
        missing = {metric: reason for metric in names if metric not in table.counts}
        table.skipped = {**missing, **table.skipped, **PROTOCOLS[name].missing}
    return Evaluation(sequence.name, source, tables, pairs.warping_error, reference_noise(sequence), floor.mean)


def _metrics(protocol: ProtocolName) -> Mapping[str, Metric]:
    return _METRICS if protocol == STRICT else PROTOCOLS[protocol].metrics


class _Pairs:
    """Metrics that depend on the motion between frames: the warped errors, and the flicker of static shots."""

    def __init__(self, table: Table) -> None:
        self._table = table
        self._last: tuple[int, Frame, Tensor, Tensor] | None = None
        self._warping: list[tuple[float, float]] = []
        self._flicker: Flicker | None = None
        self._shots: list[Flicker] = []

    def add(self, number: int, frame: Frame, image: Tensor, reference: Tensor) -> None:
        """Add the next frame."""
        last, self._last = self._last, (number, frame, image, reference)
        if last is None or last[0] != number - 1:
            self._flicker = None
            return
        _, old, *before = last
        motion = motion_to_previous(frame, old.view_projection)
        if motion is None:
            self._table.skipped[WARPED] = "the frames have no motion, and no positions with cameras"
            self._flicker = None
            return
        surface, previous = surface_before(frame), Surface(old.position, old.normal, old.depth)
        clip, truth = (torch.stack(pair, 1) for pair in zip(before, (image, reference), strict=True))
        try:
            value = float(warped_rmse_srgb(clip, truth, motion, surface, previous))
            self._table.frames[number][WARPED] = value
            ours, theirs = (float(warping_error_srgb(x, motion, surface, previous)) for x in (clip, truth))
            self._warping.append((ours, theirs))
        except UncomputableError as error:
            self._table.skipped[WARPED] = str(error)
        if not _is_still(motion):
            self._flicker = None
            return
        if self._flicker is None:
            self._flicker = Flicker()
            self._flicker.add(*before)
            self._shots.append(self._flicker)
        self._flicker.add(image, reference)

    def finish(self) -> None:
        """Add the mean flicker of all static shots to the table, weighted by their numbers of frames."""
        frames = sum(shot.frames for shot in self._shots)
        if frames:
            mean = sum(shot.frames * float(shot.value()) for shot in self._shots) / frames
            self._table.shots[FLICKER] = mean, frames
        else:
            self._table.skipped[FLICKER] = "no two successive frames with references and without motion between them"

    @property
    def warping_error(self) -> tuple[float, float] | None:
        if not self._warping:
            return None
        ours, theirs = zip(*self._warping, strict=True)
        return sum(ours) / len(ours), sum(theirs) / len(theirs)


def _is_still(motion: Tensor) -> bool:
    """Whether all known motion is negligible."""
    length = torch.hypot(motion[:, 0], motion[:, 1])
    known = length[torch.isfinite(length)]
    return known.numel() > 0 and float(known.max()) < _STILL


def open_images(folder: Path, sequence: Sequence, numbers: Collection[int]) -> dict[int, Result]:
    """Find the radiance in the image of each frame, by number, see :func:`find_images`.

    An image has the pixels of its sequence, or a part of them where the sequence's own files have parts.

    Raises:
        InputError: see :func:`find_images`; or an image has other pixels.
    """
    images = {number: open_result(path) for number, path in find_images(folder, numbers).items()}
    for found in images.values():
        (height, width), size = found.size, sequence.size
        if found.size != size and (sequence.window is None or not sequence.window.holds(found.part.window)):
            raise InputError(
                f"{found.path}: expected {size[1]} x {size[0]} pixels like the sequence, found {width} x {height}; "
                "denoise at that size"
            )
    return images


def read_image(found: Result, sequence: Sequence) -> Tensor:
    """Read a denoised image of a sequence, ``(1, 3, H, W)``, converted to the primaries of Rec. 709.

    Raises:
        InputError: it is damaged, has pixels that are not finite, or states invalid primaries.
    """
    image = found.read(None if found.size == sequence.size else sequence.window)
    bad = ~torch.isfinite(image).all(1)[0]
    if bad.any():
        row, column = bad.nonzero()[0].tolist()
        raise InputError(
            f"{found.path}: expected finite pixels, found {int(bad.sum())} NaN or infinite ones of {bad.numel()}, "
            f"first at row {row}, column {column}; errors are undefined for such pixels: repair them, or skip the frame"
        )
    with naming(str(found.path)):
        return to_rec709(image, found.metadata)


def _read(sequence: Sequence, number: int, found: Result) -> tuple[Tensor, Frame, Tensor]:
    """Read image, frame and reference; both images are converted to the primaries of Rec. 709."""
    image = read_image(found, sequence)
    with naming(f"{sequence.root}, frame {number}"):
        frame, _ = sequence.frame(number).with_depth().validate()
        if frame.reference is None:
            raise InputError("expected a reference, found none; render it")
        return image, frame, to_rec709(frame.reference, sequence.metadata(number))
