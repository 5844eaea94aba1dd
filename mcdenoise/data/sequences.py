"""Sequences: frames of a shot in whatever files a renderer wrote, opened and checked in one call."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Mapping
from collections.abc import Sequence as Sequential
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from torch import Tensor

from mcdenoise.data.exr import Image, Metadata
from mcdenoise.data.images import FORMATS
from mcdenoise.data.readers.bmfr import BmfrFolder, find_frames, is_bmfr, open_bmfr
from mcdenoise.data.readers.choice import parse_mapping
from mcdenoise.data.readers.files import RenderedFiles
from mcdenoise.data.readers.names import find_files, group_files
from mcdenoise.data.readers.noisebase import NoisebaseFiles, find_zips, open_noisebase
from mcdenoise.data.readers.opening import open_files
from mcdenoise.data.readers.values import Row
from mcdenoise.errors import InputError
from mcdenoise.frame import Frame

# Files may hold any values, also infinite ones, which are checked where a frame is used: numpy need not warn of them.
_any_values = np.errstate(over="ignore", invalid="ignore", divide="ignore")
_LARGEST_FRAME_COUNT = 1_000_000


@dataclass(frozen=True)
class Sequence:
    """The frames of one shot.

    Args:
        root: the folder, file or pattern as it was given.
        name: the name of the scene's folder, or of its only file.
        layout: the layout that was detected: ``"bmfr"``, ``"noisebase"``, ``"oidn"``, or ``"files"`` for whatever else
            renderers write.
        numbers: frame numbers, ascending.
        size: height and width in pixels, the same for every buffer and frame.
        buffers: names of the buffers that every frame of the sequence has.
        reference_numbers: frames that have a reference; possibly only some.
        color_has_albedo: whether the files hold color with the albedo in it. Frames always do.
        realisations: how many noisy colors every frame has: of the same pixels, with independent noise. Mostly 1.
        noisy: names of the buffers that each realisation has of its own: its color, and the features of its samples
            where they have noise, too.
        table: what each buffer was taken from.
        warnings: what is probably wrong, a line each.
        unused: files and layers that look like buffers and are not used.
        unknown: layers with names that say nothing.
        lights: names of the layers of light that every frame has as ``layers``.
    """

    root: Path
    name: str
    layout: str
    numbers: list[int]
    size: tuple[int, int]
    buffers: frozenset[str]
    reference_numbers: list[int]
    color_has_albedo: bool
    realisations: int
    noisy: frozenset[str]
    table: Sequential[Row] = field(repr=False)
    warnings: Sequential[str]
    unused: Sequential[str] = field(repr=False)
    unknown: Sequential[str] = field(repr=False)
    lights: Sequential[str]
    _source: BmfrFolder | NoisebaseFiles | RenderedFiles = field(repr=False)

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def folders(self) -> set[Path]:
        """Where the files lie; what is written has their names, and may not be written there."""
        return self._source.folders

    def files(self, number: int) -> list[Path]:
        """The files that a frame is made of, each once, sorted: all that lie beside one another for it, cameras too.

        Raises:
            InputError: there is no such frame.
        """
        self._check(number)
        return sorted(set(self._source.frame_files(number)))

    def part(self, numbers: Sequential[int]) -> Sequence:
        """Some of its frames, ascending, read as those of the whole are: what was decided of its values stays."""
        for number in numbers:
            self._check(number)
        chosen = set(numbers)
        referenced = [number for number in self.reference_numbers if number in chosen]
        return replace(self, numbers=list(numbers), reference_numbers=referenced)

    @_any_values
    def frame(
        self,
        number: int,
        reference: bool = True,
        realisation: int = 0,
        buffers: Collection[str] | None = None,
    ) -> Frame:
        """Read one frame: a batch of 1, float32, on the CPU; values are not validated.

        ``color`` is radiance with the albedo in it, whatever the files hold. ``depth`` is that of the depth file or
        else the clip w of the position; it is ``inf`` where nothing was hit. ``view_projection`` has the pixel
        offset of the files folded in: ``u W - 0.5, v H - 0.5`` is the pixel index. Where frames were left out before
        this one, it has neither ``motion`` nor ``previous_position``: its past is found by positions and cameras, or it
        has none.

        Args:
            number: one of ``numbers``.
            reference: whether to read the reference too, where there is one.
            realisation: which noisy color, from 0 to ``realisations - 1``, with its other ``noisy`` buffers; the
                others are the same for all.
            buffers: names of those that are of use: of parts of the light and samples (``PARTS``), which take time to
                read, the others are left out. All by default.

        Raises:
            InputError: there is no such frame or realisation, or a file is damaged.
        """
        self._check(number)
        if not 0 <= realisation < self.realisations:
            raise InputError(
                f"{self.root}: expected a realisation of the noise from 0 to {self.realisations - 1}, "
                f"found {realisation}; render more of them"
            )
        frame = self._source.frame(number, reference=reference, realisation=realisation, buffers=buffers)
        if self.numbers.index(number) == 0 or number - 1 in self.numbers:
            return frame
        # They lead to a frame that was not chosen, and not to the one before in this sequence.
        return frame.replace(motion=None, previous_position=None)

    @_any_values
    def reference(self, number: int) -> Tensor:
        """Read the reference of one frame, and nothing else.

        Args:
            number: one of ``reference_numbers``.

        Returns:
            ``(1, 3, H, W)`` radiance, float32, on the CPU; as :meth:`frame` gives it.

        Raises:
            InputError: there is no such frame, it has no reference, or the file is damaged.
        """
        self._check(number)
        if number not in self.reference_numbers:
            raise InputError(f"{self.root}: expected the reference of frame {number}, found none; render it")
        return self._source.reference(number)

    def metadata(self, number: int) -> Metadata:
        """Attributes of the color file of one frame: texts, numbers and tuples of numbers.

        Raises:
            InputError: there is no such frame, or its file is damaged.
        """
        self._check(number)
        return self._source.metadata(number)

    @_any_values
    def check_output_layer(self, name: str) -> None:
        """See that a layer of this name can be added.

        Raises:
            InputError: it cannot: the name is no word, the files have a layer of it already, or they have no layers.
        """
        if not isinstance(self._source, RenderedFiles):
            raise InputError(
                f"{self.root}: expected files with layers to add '{name}' to, found the {self.layout} layout; "
                "leave out --output-layer: the files stay as they are"
            )
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
        """Write the clean image of one frame: the file that held its radiance, under its own name, clean.

        Whatever else is in the file stays as it was: layers, parts, attributes, windows, compression, types of numbers.
        In the BMFR layout, where each file is a buffer, it is a file ``denoisedN`` beside the ``colorN`` that it is of.

        Args:
            out: folder to write to. It must exist.
            number: one of ``numbers``.
            image: ``(H, W, 3)`` radiance.
            alpha: ``(H, W, 1)`` coverage; that of the file stays by default.
            lights: ``(H, W, 3)`` radiance of layers of light, by the names in ``frame.layers``.
            output_layer: name of a layer to be added; then nothing is replaced.
            full_float: store what is written as 32-bit floats, whatever it was before.

        Returns:
            The file.

        Raises:
            InputError: the file cannot be written.
        """
        self._check(number)
        if output_layer is not None:
            self.check_output_layer(output_layer)
        if not isinstance(self._source, RenderedFiles):
            # There is neither alpha nor a layer.
            return self._source.write(out, number, image, full_float=full_float)
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
) -> Sequence:
    """Open the frames of a shot: headers of all chosen files are checked, and the pixels of the first one looked at.

    Args:
        path: a folder, or the one that has a folder ``inputs`` inside it; a file; a pattern such as ``shot_####.exr``;
            or several of these. Zips of Noisebase: one of a sequence, or those of its frames, or the folder of these.
        frames: which frames to use, such as ``"0-59,70"``; all of them by default.
        mapping: layers by buffer where names do not tell, such as ``"albedo=RGBA.diff"``; ``"motion="`` for none.
        color_has_albedo: whether radiance has the albedo in it; told by the files' values by default.
        lights: names of layers of light that add up to the color, or ``("all",)``: a frame has them as ``layers``.

    Raises:
        InputError: nothing is there, the files do not tell what they are, a frame or buffer is missing, or files do not
            fit together.
    """
    given = [Path(path)] if isinstance(path, str | Path) else [Path(each) for each in path]
    if not given:
        raise InputError("input: expected a folder, a file or a pattern, found nothing")
    where = str(given[0]) if len(given) == 1 else f"{given[0]} and {len(given) - 1} more"
    folder = _bmfr_folder(given)
    found: list[str] = []

    def chosen(present: list[int]) -> list[int]:
        numbers = _choose(given[0], present, frames)
        found.extend(_gaps(present) if frames is None else [])
        return numbers

    source: BmfrFolder | NoisebaseFiles | RenderedFiles
    if folder is not None and not mapping and not lights:
        files = find_frames(folder) or {"color": {}}
        source, layout = open_bmfr(folder, files, chosen(sorted(files["color"])), color_has_albedo), "bmfr"
    elif zips := find_zips(given):
        if mapping or lights:
            raise InputError(f"{where}: expected neither --map nor --layers, found one: these arrays have their names")
        source, layout = open_noisebase(zips, chosen, where=where), "noisebase"
    else:
        paths = find_files([folder] if folder is not None else given)
        if not paths:
            others = ", ".join(sorted({each.suffix for each in given[0].glob("*.*")})[:8]) if given[0].is_dir() else ""
            raise InputError(
                f"{where}: expected images that a renderer wrote ({', '.join(FORMATS)}), found "
                f"{f'only {others}' if others else 'none'}; check the path"
            )
        groups, layout = group_files(paths)
        source = open_files(
            groups,
            chosen,
            where=where,
            mapping=parse_mapping(mapping),
            color_has_albedo=color_has_albedo,
            lights=lights,
        )
    return _wrap(given[0], layout, source, found)


def frame_numbers(path: Path | Sequential[Path], frames: str | None = None) -> list[int]:
    """Which frames are there, by the names of their files alone, whatever is in them.

    Args:
        path: see :func:`open_sequence`.
        frames: likewise; numbers of frames that are not there are left out.

    Returns:
        The frame numbers, ascending; none where names do not tell.

    Raises:
        InputError: nothing is there, or the choice of frames is no such text.
    """
    given = [Path(path)] if isinstance(path, str | Path) else [Path(each) for each in path]
    folder = _bmfr_folder(given)
    if folder is not None:
        numbers = set((find_frames(folder) or {"color": {}})["color"])
    elif find_zips(given):
        return []
    else:
        groups, _ = group_files(find_files(given))
        numbers = {number for group in groups for number in group.files if number >= 0}
    return sorted(numbers if frames is None else numbers & set(parse_frames(frames)))


def _bmfr_folder(given: Sequential[Path]) -> Path | None:
    """The folder of frames in that layout, if that is what was given; or one ``inputs`` in it."""
    (path, *more) = given
    if more or not os.path.isdir(path):
        return None
    for folder in (path, path / "inputs"):
        if os.path.isdir(folder) and is_bmfr(folder):
            return folder
    return None


def with_unique_names(sequences: list[Sequence]) -> list[Sequence]:
    """The same sequences; the second of a name gets a number, so that tables and folders keep them apart."""
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
    """Read a choice of frames.

    Args:
        text: numbers and ranges, such as ``"0-59,70"``.
        name: what is chosen, for the message.

    Returns:
        The frame numbers, ascending, each once.

    Raises:
        InputError: the text is something else, or names more than a million frames.

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
    if frames is not None:
        chosen = parse_frames(frames)
        absent = sorted(set(chosen) - set(present))
        if absent:
            raise InputError(
                f"{folder}: expected frame {absent[0]}, found frames {_summary(present)}; choose among these"
            )
        return chosen
    return present


def _gaps(present: list[int]) -> list[str]:
    """What is missing between the frames that are there."""
    missing = [(a + 1, b - 1) for a, b in pairwise(present) if b != a + 1]
    if not missing:
        return []
    spans = ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in missing[:8])
    more = f" and {len(missing) - 8} more" if len(missing) > 8 else ""
    return [f"frames: {spans}{more} missing; the history begins anew behind a gap, unless positions lead across it"]


def _summary(numbers: list[int]) -> str:
    return f"{numbers[0]} to {numbers[-1]}"


def _wrap(root: Path, layout: str, source: BmfrFolder | NoisebaseFiles | RenderedFiles, gaps: list[str]) -> Sequence:
    name = root.resolve().name
    if name == "inputs":
        name = root.resolve().parent.name
    return Sequence(
        root=root,
        name=name,
        layout=layout,
        numbers=source.numbers,
        size=source.size,
        buffers=source.buffers,
        reference_numbers=source.reference_numbers,
        color_has_albedo=source.color_has_albedo,
        realisations=source.realisations,
        noisy=source.noisy if isinstance(source, BmfrFolder) else frozenset({"color"}),
        table=source.table,
        warnings=[*gaps, *source.warnings],
        unused=source.unused,
        unknown=source.unknown if isinstance(source, RenderedFiles) else (),
        lights=list(source.lights) if isinstance(source, RenderedFiles) else [],
        _source=source,
    )
