"""Sequences: the frames of a shot, in any supported files, opened and checked by one call."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from collections.abc import Sequence as Sequential
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from torch import Tensor

from mcdenoise.data.exr import Image, Metadata
from mcdenoise.data.images import FORMATS, Window
from mcdenoise.data.readers.bmfr import find_bmfr, open_bmfr
from mcdenoise.data.readers.choice import parse_mapping
from mcdenoise.data.readers.names import FileGroup, find_files, group_files
from mcdenoise.data.readers.noisebase import find_zips, open_noisebase
from mcdenoise.data.readers.opening import ColorSpace, open_files
from mcdenoise.data.readers.source import Source
from mcdenoise.data.readers.values import Row
from mcdenoise.errors import InputError
from mcdenoise.frame import Frame

# Files may contain any values, also infinite ones, which are checked when a frame is used: suppress numpy's warnings.
_any_values = np.errstate(over="ignore", invalid="ignore", divide="ignore")
_LARGEST_FRAME_COUNT = 1_000_000


@dataclass(frozen=True)
class Sequence:
    """The frames of one shot.

    Args:
        root: the folder, file or pattern that was passed.
        name: the name of the scene's folder, or of its only file.
        layout: the detected layout: ``"bmfr"``, ``"noisebase"``, ``"oidn"``, or ``"files"`` for all other renderers.
        numbers: frame numbers, ascending.
        size: height and width in pixels, the same for every buffer and frame.
        buffers: names of the buffers that every frame of the sequence has.
        reference_numbers: frames that have a reference; possibly only some.
        color_has_albedo: whether the color in the files includes the albedo. The color of frames always does.
        noise_seeds: number of noisy colors per frame, with different noise seeds; usually 1.
        noisy: names of the buffers that differ between noise seeds: the color, and features that have noise.
        table: the source of each buffer.
        warnings: probable mistakes, one line each.
        unused: files and layers that look like buffers but are not used.
        unknown: layers with unknown names.
        lights: names of the layers of light that every frame has in ``layers``.
    """

    root: Path
    name: str
    layout: str
    numbers: list[int]
    size: tuple[int, int]
    buffers: frozenset[str]
    reference_numbers: list[int]
    color_has_albedo: bool
    noise_seeds: int
    noisy: frozenset[str]
    table: Sequential[Row] = field(repr=False)
    warnings: Sequential[str]
    unused: Sequential[str] = field(repr=False)
    unknown: Sequential[str] = field(repr=False)
    lights: Sequential[str]
    _source: Source = field(repr=False)

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def folders(self) -> set[Path]:
        """The folders of the input files; results have the same names, so they may not be written there."""
        return self._source.folders

    def files(self, number: int) -> list[Path]:
        """The files of a frame, sorted and without duplicates, including camera files.

        Raises:
            InputError: the frame does not exist.
        """
        self._check(number)
        return sorted(set(self._source.frame_files(number)))

    @property
    def window(self) -> Window | None:
        """The window of all frames, if the files have data windows that differ; each is written in its own."""
        return self._source.window

    def part(self, numbers: Sequential[int]) -> Sequence:
        """Select some frames, ascending; how the values are read does not change."""
        for number in numbers:
            self._check(number)
        chosen = set(numbers)
        referenced = [number for number in self.reference_numbers if number in chosen]
        return replace(self, numbers=list(numbers), reference_numbers=referenced)

    def first_valid_frame(self) -> Frame | None:
        """The first frame without damage, by which to choose a model; ``None`` for files of a renderer.

        With one sample, features of those are from the pixel centre whatever the filter is, so that they decide
        nothing.
        """
        for number in self.numbers if self.layout != "files" else ():
            # A damaged frame is reported when it is denoised.
            with suppress(InputError):
                return self.frame(number, reference=False)
        return None

    @_any_values
    def frame(
        self,
        number: int,
        reference: bool = True,
        noise_seed: int = 0,
        buffers: Collection[str] | None = None,
    ) -> Frame:
        """Read one frame: a batch of 1, float32, on the CPU; values are not validated.

        ``color`` is radiance including albedo, whatever the files hold. ``depth`` is read from a depth file, or
        computed as clip w of the position; it is ``inf`` where nothing was hit. ``view_projection`` includes the pixel
        offset of the files: ``u W - 0.5, v H - 0.5`` is the pixel index. If the frame before this one was not selected,
        the frame has neither ``motion`` nor ``previous_position``; its history is found through positions and cameras,
        or not at all.

        Args:
            number: one of ``numbers``.
            reference: whether to read the reference, if there is one.
            noise_seed: index of the noise seed, from 0 to ``noise_seeds - 1``: it selects the ``noisy`` buffers; the
                others are the same for all seeds.
            buffers: names of the buffers in use. Parts of the light and samples (``LIGHT_PARTS``), which are slow to
                read, are skipped if they are not among them. All by default.

        Raises:
            InputError: the frame or the noise seed does not exist, or a file is damaged.
        """
        self._check(number)
        if not 0 <= noise_seed < self.noise_seeds:
            raise InputError(
                f"{self.root}: expected a noise seed from 0 to {self.noise_seeds - 1}, "
                f"found {noise_seed}; render more of them"
            )
        frame = self._source.frame(number, reference=reference, noise_seed=noise_seed, buffers=buffers)
        if self.numbers.index(number) == 0 or number - 1 in self.numbers:
            return frame
        # They refer to a frame that was not selected, not to the previous one of this sequence.
        return frame.replace(motion=None, previous_position=None)

    @_any_values
    def reference(self, number: int) -> Tensor:
        """Read only the reference of one frame.

        Args:
            number: one of ``reference_numbers``.

        Returns:
            ``(1, 3, H, W)`` radiance, float32, on the CPU; the same as from :meth:`frame`.

        Raises:
            InputError: the frame does not exist, it has no reference, or the file is damaged.
        """
        self._check(number)
        if number not in self.reference_numbers:
            raise InputError(f"{self.root}: expected the reference of frame {number}, found none; render it")
        return self._source.reference(number)

    def metadata(self, number: int) -> Metadata:
        """Attributes of the color file of one frame: texts, numbers and tuples of numbers.

        Raises:
            InputError: the frame does not exist, or its file is damaged.
        """
        self._check(number)
        return self._source.metadata(number)

    @_any_values
    def check_output_layer(self, name: str) -> None:
        """Check that a layer of this name can be added.

        Raises:
            InputError: the name is invalid, or the files have such a layer already or have no layers.
        """
        self._source.check_output_layer(name)

    def write(
        self,
        out: Path,
        number: int,
        image: Image,
        *,
        alpha: Image | None = None,
        lights: Mapping[str, Image] | None = None,
        output_layer: str | None = None,
        full_float: bool = False,
    ) -> Path:
        """Write the denoised image of one frame to a file with the name of the color file.

        Everything else is copied unchanged: layers, parts, attributes, windows, compression, pixel types. In the BMFR
        layout, where each file is a buffer, the file is ``denoisedN`` for the color ``colorN``.

        Args:
            out: folder to write to. It must exist.
            number: one of ``numbers``.
            image: ``(H, W, 3)`` radiance.
            alpha: ``(H, W, 1)`` coverage; by default that of the file is kept.
            lights: ``(H, W, 3)`` radiance of layers of light, by the names in ``frame.layers``.
            output_layer: name of a layer to add; then nothing is replaced.
            full_float: store the written channels as 32-bit floats, whatever they were before.

        Returns:
            The path of the file.

        Raises:
            InputError: the file cannot be written.
        """
        self._check(number)
        if output_layer is not None:
            self.check_output_layer(output_layer)
        return self._source.write(
            out, number, image, alpha=alpha, lights=lights, output_layer=output_layer, full_float=full_float
        )

    def _check(self, number: int) -> None:
        if number not in self.numbers:
            raise InputError(
                f"{self.root}: expected a frame of the sequence ({_summary(self.numbers)}), found {number}"
            )


@_any_values
def open_sequence(
    path: Path | Sequential[Path],
    frames: str | None = None,
    *,
    mapping: Sequential[str] = (),
    color_has_albedo: bool | None = None,
    lights: Sequential[str] = (),
    color_space: ColorSpace = "auto",
) -> Sequence:
    """Open the frames of a shot: the headers of all selected files are checked, and the pixels of the first frame.

    Args:
        path: a folder, or a folder that contains it as ``inputs``; a file; a pattern such as ``shot_####.exr``; or
            several of these. For Noisebase: the zip of a sequence, the zips of its frames, or a folder of zips.
        frames: frames to use, such as ``"0-59,70"``; all by default.
        mapping: layers by buffer if names do not tell, such as ``"albedo=RGBA.diff"``; ``"motion="`` for none.
        color_has_albedo: whether the radiance includes the albedo; by default determined from the values.
        lights: names of layers of light that add up to the color, or ``("all",)``: frames have them in ``layers``.
        color_space: ``"linear"`` or ``"srgb"`` for TIFF, PNG, PFM and HDR files; by default what the files say, or
            else sRGB for 8 and 16 bits, and linear for floats.

    Raises:
        InputError: nothing was found, the files cannot be recognised, a frame or buffer is missing, or files do not
            match one another.
    """
    given = [Path(path)] if isinstance(path, str | Path) else [Path(each) for each in path]
    if not given:
        raise InputError("input: expected a folder, a file or a pattern, found nothing")
    gaps: list[str] = []

    def chosen(present: list[int]) -> list[int]:
        gaps.extend(_gaps(present) if frames is None else [])
        return _choose(given[0], present, frames)

    where = str(given[0]) if len(given) == 1 else f"{given[0]} and {len(given) - 1} more"
    bmfr = find_bmfr(given)
    source: Source
    if bmfr is not None and not mapping and not lights:
        source, layout = open_bmfr(*bmfr, chosen, color_has_albedo), "bmfr"
    elif zips := find_zips(given):
        if mapping or lights:
            raise InputError(f"{where}: expected neither --map nor --layers, found one: these arrays have their names")
        source, layout = open_noisebase(zips, chosen, where=where), "noisebase"
    else:
        groups, layout = _groups(given if bmfr is None else [bmfr[0]], where)
        named = parse_mapping(mapping)
        source = open_files(groups, chosen, where, named, color_has_albedo, lights, color_space)
    place = given[0].resolve()
    alike = ("numbers", "size", "buffers", "reference_numbers", "color_has_albedo", "noise_seeds", "noisy", "table")
    return Sequence(
        root=given[0],
        name=place.parent.name if place.name == "inputs" else place.name,
        layout=layout,
        warnings=[*gaps, *source.warnings],
        unused=source.unused,
        unknown=source.unknown,
        lights=list(source.lights),
        _source=source,
        **{name: getattr(source, name) for name in alike},
    )


def _groups(given: Sequential[Path], where: str) -> tuple[list[FileGroup], str]:
    paths = find_files(given)
    if not paths:
        others = ", ".join(sorted({each.suffix for each in given[0].glob("*.*")})[:8]) if given[0].is_dir() else ""
        raise InputError(
            f"{where}: expected images that a renderer wrote ({', '.join(FORMATS)}), found "
            f"{f'only {others}' if others else 'none'}; check the path"
        )
    return group_files(paths)


def frame_numbers(path: Path | Sequential[Path], frames: str | None = None) -> list[int]:
    """The numbers of the existing frames, from file names alone.

    Args:
        path: see :func:`open_sequence`.
        frames: see :func:`open_sequence`; missing frames are omitted.

    Returns:
        The frame numbers, ascending; empty if names do not tell.

    Raises:
        InputError: nothing was found, or ``frames`` is invalid.
    """
    given = [Path(path)] if isinstance(path, str | Path) else [Path(each) for each in path]
    if (bmfr := find_bmfr(given)) is not None:
        numbers = set(bmfr[1]["color"])
    elif find_zips(given):
        return []
    else:
        groups, _ = group_files(find_files(given))
        numbers = {number for group in groups for number in group.files if number >= 0}
    return sorted(numbers if frames is None else numbers & set(parse_frames(frames)))


def with_unique_names(sequences: list[Sequence]) -> list[Sequence]:
    """Add numbers to duplicate names of sequences, so that tables and folders keep them apart."""
    unique: list[Sequence] = []
    names: set[str] = set()
    for sequence in sequences:
        name, number = sequence.name, 2
        while name in names:
            name, number = f"{sequence.name} ({number})", number + 1
        names.add(name)
        unique.append(replace(sequence, name=name))
    return unique


def parse_frames(text: str, name: str = "frames") -> list[int]:
    """Parse a selection of frames.

    Args:
        text: numbers and ranges, such as ``"0-59,70"``.
        name: what is selected, for the message.

    Returns:
        The frame numbers, ascending, each once.

    Raises:
        InputError: the text has another form, or selects more than a million frames.

    Example:
        >>> parse_frames("0-3, 70")
        [0, 1, 2, 3, 70]
    """
    numbers: set[int] = set()
    for part in text.split(","):
        match = re.fullmatch(r"\s*([0-9]{1,9})(?:\s*-\s*([0-9]{1,9}))?\s*", part)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
        if not first <= last < first + _LARGEST_FRAME_COUNT - len(numbers):
            raise InputError(f"{name}: expected numbers and ascending ranges such as '0-59,70', found {text[:80]!r}")
        numbers.update(range(first, last + 1))
    return sorted(numbers)


def _choose(folder: Path, present: list[int], frames: str | None) -> list[int]:
    chosen = present if frames is None else parse_frames(frames)
    if absent := sorted(set(chosen) - set(present)):
        raise InputError(f"{folder}: expected frame {absent[0]}, found frames {_summary(present)}; choose among these")
    return chosen


def _gaps(present: list[int]) -> list[str]:
    """A warning about missing frame numbers."""
    missing = [(a + 1, b - 1) for a, b in pairwise(present) if b != a + 1]
    if not missing:
        return []
    spans = ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in missing[:8])
    more = f" and {len(missing) - 8} more" if len(missing) > 8 else ""
    return [f"frames: {spans}{more} missing; the history begins anew behind a gap, unless positions lead across it"]


def _summary(numbers: list[int]) -> str:
    return f"{numbers[0]} to {numbers[-1]}"
