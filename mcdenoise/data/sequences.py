"""Sequences: folders of frames in known layouts, opened and checked in one call."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Protocol

from torch import Tensor

from mcdenoise.data.bmfr import find_frames, open_bmfr
from mcdenoise.data.exr import Metadata
from mcdenoise.errors import InputError
from mcdenoise.frame import Frame

_LARGEST_FRAME_COUNT = 1_000_000
_KNOWN_LAYOUTS = "bmfr: color0.exr, color1.exr, ... in it or in its 'inputs'"


class Layout(Protocol):
    """What a layout has to know about the frames that were chosen from a folder."""

    @property
    def numbers(self) -> list[int]:
        """Frames in use, ascending."""
        ...

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        ...

    @property
    def buffers(self) -> frozenset[str]:
        """Names of the buffers that every frame has."""
        ...

    @property
    def reference_numbers(self) -> list[int]:
        """Frames in use that have a reference."""
        ...

    @property
    def color_has_albedo(self) -> bool:
        """Whether color is stored with the albedo in it."""
        ...

    @property
    def realisations(self) -> int:
        """How many noisy colors every frame in use has."""
        ...

    def frame(self, number: int, *, reference: bool = True, realisation: int = 0) -> Frame:
        """Read one frame."""
        ...

    def reference(self, number: int) -> Tensor:
        """Read the reference of one frame that has one."""
        ...

    def metadata(self, number: int) -> Metadata:
        """Attributes of one frame's color file."""
        ...


@dataclass(frozen=True)
class Sequence:
    """The frames of one folder.

    Args:
        root: the folder as it was given.
        name: the name of the scene's folder.
        layout: the layout that was detected: ``"bmfr"``.
        numbers: frame numbers, ascending.
        size: height and width in pixels, the same for every buffer and frame.
        buffers: names of the buffers that every frame of the sequence has.
        reference_numbers: frames that have a reference; possibly only some.
        color_has_albedo: whether the files hold color with the albedo in it. Frames always do.
        realisations: how many noisy colors every frame has: of the same pixels, with independent noise. Mostly 1.
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
    _source: Layout = field(repr=False)

    def __len__(self) -> int:
        return len(self.numbers)

    def frame(self, number: int, reference: bool = True, realisation: int = 0) -> Frame:
        """Read one frame: a batch of 1, float32, on the CPU; values are not validated.

        ``color`` is radiance with the albedo in it, whatever the files hold. ``depth`` is that of the depth file or
        else the clip w of the position; it is ``inf`` where nothing was hit. ``view_projection`` has the pixel
        offset of the files folded in: ``u W - 0.5, v H - 0.5`` is the pixel index. Where frames were left out before
        this one, it has neither ``motion`` nor ``previous_position``: its past is found by positions and cameras, or it
        has none.

        Args:
            number: one of ``numbers``.
            reference: whether to read the reference too, where there is one.
            realisation: which noisy color, from 0 to ``realisations - 1``; the other buffers are the same for all.

        Raises:
            InputError: there is no such frame or realisation, or a file is damaged.
        """
        self._check(number)
        if not 0 <= realisation < self.realisations:
            raise InputError(
                f"{self.root}: expected a realisation of the noise from 0 to {self.realisations - 1}, "
                f"found {realisation}; render more of them"
            )
        frame = self._source.frame(number, reference=reference, realisation=realisation)
        if self.numbers.index(number) == 0 or number - 1 in self.numbers:
            return frame
        # They lead to a frame that was not chosen, and not to the one before in this sequence.
        return frame.replace(motion=None, previous_position=None)

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

    def _check(self, number: int) -> None:
        if number not in self.numbers:
            raise InputError(
                f"{self.root}: expected a frame of the sequence ({_summary(self.numbers)}), found {number}"
            )


def open_sequence(path: Path, frames: str | None = None) -> Sequence:
    """Open a folder of frames; headers of all chosen files are checked, pixels are not read.

    Args:
        path: the folder of a scene, or the folder ``inputs`` inside it.
        frames: which frames to use, such as ``"0-59,70"``; all of them by default.

    Raises:
        InputError: there is no such folder, its layout is unknown, a frame or buffer is missing, or files do not fit
            together.
    """
    path = Path(path)
    if not os.path.isdir(path):
        found = "a file" if os.path.isfile(path) else "no such folder"
        raise InputError(f"{path}: expected the folder of a sequence, found {found}; check the path")
    for folder in (path, path / "inputs"):
        files = find_frames(folder) if os.path.isdir(folder) else None
        if files is not None:
            numbers = _choose(folder, sorted(files["color"]), frames)
            return _wrap(path, "bmfr", open_bmfr(folder, files, numbers))
    raise InputError(
        f"{path}: expected frames in a known layout ({_KNOWN_LAYOUTS}), found no color file; check the path"
    )


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
    for before, after in pairwise(present):
        if after != before + 1:
            raise InputError(
                f"{folder}: expected frame {before + 1} after frame {before}, found {after}; "
                f"render the missing frames, or choose frames such as '{present[0]}-{before}'"
            )
    return present


def _summary(numbers: list[int]) -> str:
    return f"{numbers[0]} to {numbers[-1]}"


def _wrap(root: Path, layout: str, source: Layout) -> Sequence:
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
        _source=source,
    )
