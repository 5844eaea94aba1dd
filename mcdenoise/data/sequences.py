"""Sequences: the frames of a shot, in any supported files, opened and checked by one call."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from collections.abc import Sequence as Sequential
from dataclasses import replace
from itertools import chain, count, pairwise
from pathlib import Path

from mcdenoise.data.images import FORMATS
from mcdenoise.data.readers.bmfr import find_bmfr, open_bmfr
from mcdenoise.data.readers.choice import parse_mapping
from mcdenoise.data.readers.names import FileGroup, find_files, group_files, with_stills
from mcdenoise.data.readers.noisebase import find_zips, open_noisebase
from mcdenoise.data.readers.opening import ColorSpace, open_files
from mcdenoise.data.readers.sequence import Sequence, any_values, summary
from mcdenoise.errors import InputError

_LARGEST_FRAME_COUNT = 1_000_000


@any_values
def open_sequence(
    path: Path | Sequential[Path] | Mapping[str, Path],
    frames: str | None = None,
    *,
    mapping: Sequential[str] = (),
    color_has_albedo: bool | None = None,
    lights: Sequential[str] = (),
    color_space: ColorSpace = "auto",
) -> Sequence:
    """Open the frames of a shot: the headers of all selected files are checked, and the pixels of the first frame.

    Args:
        path: a folder, or a folder that contains it as ``inputs``, or one for each buffer; a file; a pattern such as
            ``shot_####.exr``; or several of these; or one for each buffer, by buffer. For Noisebase: the zip of a
            sequence, the zips of its frames, or a folder of zips.
        frames: frames to use, such as ``"0-59,70"``; all by default.
        mapping: layers by buffer if names do not tell, such as ``"albedo=RGBA.diff"``; ``"motion="`` for none.
        color_has_albedo: whether the radiance includes the albedo; by default determined from the values.
        lights: names of layers of light that add up to the color, or ``("all",)``: frames have them in ``layers``.
        color_space: ``"linear"`` or ``"srgb"`` for TIFF, PNG, PFM and HDR files; by default what the files say, or
            else sRGB for 8 and 16 bits, and linear for floats.

    Raises:
        InputError: nothing was found, the files cannot be recognised, a frame or buffer is missing, or files do not
            match one another or the buffer that they are given as.
    """
    by_buffer = path if isinstance(path, Mapping) else {}
    given = _given(path.values() if isinstance(path, Mapping) else path)
    if not given:
        raise InputError("input: expected a folder, a file or a pattern, found nothing")
    gaps: list[str] = []

    def chosen(present: list[int]) -> list[int]:
        gaps.extend(_gaps(present) if frames is None else [])
        wanted = present if frames is None else parse_frames(frames)
        if absent := sorted(set(wanted) - set(present)):
            found = summary(present)
            raise InputError(f"{given[0]}: expected frame {absent[0]}, found frames {found}; choose among these")
        return wanted

    where = str(given[0]) if len(given) == 1 else f"{given[0]} and {len(given) - 1} more"
    bmfr = None if by_buffer else find_bmfr(given)
    sequence: Sequence
    if bmfr is not None and not mapping and not lights:
        sequence, layout = open_bmfr(*bmfr, chosen, color_has_albedo), "bmfr"
    elif not by_buffer and (zips := find_zips(given)):
        if mapping or lights:
            raise InputError(f"{where}: expected neither --map nor --layers, found one: these arrays have their names")
        sequence, layout = open_noisebase(zips, chosen, where=where), "noisebase"
    else:
        if by_buffer:
            own = ((name, _groups([each], where)[0]) for name, each in zip(by_buffer, given, strict=True))
            groups = with_stills([replace(group, label=name) for name, found in own for group in found])
            layout = "files"
        else:
            groups, layout = _groups(given if bmfr is None else [bmfr[0]], where)
        named = parse_mapping(mapping)
        sequence = open_files(groups, chosen, where, named, color_has_albedo, lights, color_space)
        for name in (each for each in by_buffer if each not in sequence.buffers):
            raise InputError(f"{by_buffer[name]}: expected channels of the buffer '{name}', found others; leave it out")
    place = given[0].resolve()
    name = place.parent.name if place.name == "inputs" else place.name
    return replace(sequence, root=given[0], name=name, layout=layout, warnings=[*gaps, *sequence.warnings])


def _given(path: Path | Iterable[Path]) -> list[Path]:
    return [Path(path)] if isinstance(path, str | Path) else [Path(each) for each in path]


def _groups(given: Sequential[Path], where: str) -> tuple[list[FileGroup], str]:
    paths = find_files(given)
    if not paths:
        inside = sorted(given[0].glob("*")) if given[0].is_dir() else []
        others = sorted({f"{each.name}/" if each.is_dir() else each.suffix for each in inside} - {""})
        raise InputError(
            f"{where}: expected images that a renderer wrote ({', '.join(FORMATS)}), found "
            f"{'only ' * bool(others) + (', '.join(others[:8]) or 'none')}; name the folder with the images, or several"
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
    given = _given(path)
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
    for sequence in sequences:
        names = chain([sequence.name], (f"{sequence.name} ({number})" for number in count(2)))
        taken = {each.name for each in unique}
        unique.append(replace(sequence, name=next(name for name in names if name not in taken)))
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


def _gaps(present: list[int]) -> list[str]:
    """A warning about missing frame numbers."""
    missing = [(a + 1, b - 1) for a, b in pairwise(present) if b != a + 1]
    if not missing:
        return []
    spans = ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in missing[:8])
    more = f" and {len(missing) - 8} more" if len(missing) > 8 else ""
    return [f"frames: {spans}{more} missing; the history begins anew behind a gap, unless positions lead across it"]
