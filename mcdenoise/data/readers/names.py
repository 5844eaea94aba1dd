"""File names: which digits are the frame number, and which files are of the same kind."""

from __future__ import annotations

import fnmatch
import os
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from mcdenoise.data.files import listed
from mcdenoise.data.images import FORMATS
from mcdenoise.errors import InputError

# OIDN's training data, `name_0008spp.hdr.exr`: the digits are the number of samples.
_OIDN = re.compile(r"(?P<name>.+?)_(?P<samples>[0-9]{1,9})spp\.(?P<buffer>hdr|ldr|alb|nrm|z)", re.IGNORECASE)
_PLACEHOLDER = re.compile(r"#+|%0?[0-9]*d")
# A minus sign counts only if no word precedes it: in `shot_-0002`, but not in `shot-0002`.
_MINUS = "(?<=[_. ])-"
_DIGITS = re.compile(f"((?:{_MINUS})?[0-9]{{1,18}})")


@dataclass(frozen=True)
class FileGroup:
    """Files of one kind, one per frame.

    Args:
        label: the file names without the number, such as ``shot_albedo``.
        files: by frame number.
    """

    label: str
    files: Mapping[int, Path]

    @property
    def first(self) -> Path:
        """The file of its first frame."""
        return next(iter(self.files.values()))


def find_files(inputs: Sequence[Path]) -> list[Path]:
    """Find the image files for given folders, files and patterns, sorted.

    Args:
        inputs: folders, for all images in them, or if there are none in their folders, that are not hidden; files; and
            patterns, whose last part may contain ``####``, ``%04d``, ``*``, ``?`` and ``[...]``.

    Raises:
        InputError: a path or pattern matches nothing.
    """
    found: dict[Path, None] = {}
    for given in inputs:
        if os.path.isdir(given):
            new = _images_in(given)
            if not new:
                # A folder of folders has one for each buffer.
                inside = [each for each in listed(given) if os.path.isdir(each) and not each.name.startswith(".")]
                new = [image for each in inside for image in _images_in(each)]
        elif os.path.lexists(given):
            # It may be anything; opening it reports the error.
            new = [given]
        else:
            new = _matches(given)
        found.update(dict.fromkeys(new))
    return list(found)


def _images_in(folder: Path) -> list[Path]:
    return [each for each in listed(folder) if each.suffix.lower() in FORMATS and not each.name.startswith(".")]


def _matches(pattern: Path) -> list[Path]:
    folder, name = pattern.parent, pattern.name
    # Hash marks match only digits: `shot_####.exr` does not match `shot_0001_mask.exr`.
    pieces = re.split(f"({_PLACEHOLDER.pattern})", name)
    wild = any(mark in name for mark in "*?[")
    if len(pieces) == 1 and not wild:
        raise InputError(
            f"{pattern}: expected a folder, an image, or a pattern such as shot_####.exr, found "
            "no such folder or file; check the path"
        )
    if not os.path.isdir(folder):
        raise InputError(f"{pattern}: expected files, found no folder {folder}; check the path")
    images = _images_in(folder)
    # At least as many digits as there are hash marks, or as the format says, which counts a minus sign.
    digits = [each.count("#") or int(each.strip("%d") or 1) or 1 for each in pieces[1::2]]
    # Brackets may be part of a file name; they are placeholders only if no such file exists.
    for translated in (re.escape, _translated) if wild else (re.escape,):
        texts = iter([translated(each) for each in pieces[::2]])
        expression = next(texts) + "".join(
            f"(?:[0-9]|{_MINUS}){{{least},9}}{text}" for least, text in zip(digits, texts, strict=True)
        )
        if found := [path for path in images if re.fullmatch(expression, path.name)]:
            return found
    raise InputError(f"{pattern}: expected files with such names, found none; check the pattern")


def _translated(text: str) -> str:
    """A glob as a regular expression without anchors."""
    return fnmatch.translate(text).removeprefix("(?s:")[: -len(r")\Z")]


def group_files(paths: Sequence[Path]) -> tuple[list[FileGroup], str]:
    """Group files by kind.

    Files of a kind have equal names except for digits. The digits that vary within such a group are the frame number;
    if none varies, the last digits are.

    Args:
        paths: the files.

    Returns:
        The kinds, and the name of the layout.

    Raises:
        InputError: two numbers vary, or two files of a kind have the same frame number.
    """
    oidn = [(path, match) for path in paths if (match := _OIDN.fullmatch(path.stem))]
    if oidn and len(oidn) == len(paths):
        return _oidn_groups(oidn), "oidn"
    alike: defaultdict[tuple[Path, tuple[str, ...], str], list[tuple[Path, list[str]]]] = defaultdict(list)
    for path in paths:
        pieces = _DIGITS.split(path.stem)
        alike[path.parent, tuple(pieces[::2]), path.suffix.lower()].append((path, pieces[1::2]))
    groups: list[FileGroup] = []
    for (_, texts, _), members in alike.items():
        groups += _split_by_number(texts, members)
    return _named_by_folders(with_stills(groups)), "files"


def _named_by_folders(groups: list[FileGroup]) -> list[FileGroup]:
    """Name files of equal names in several folders after these: `albedo/0001.exr` beside `color/0001.exr`."""
    folders = [group.first.parent for group in groups]
    count = Counter(label for label, _ in {(g.label, each) for g, each in zip(groups, folders, strict=True)})
    return [
        replace(group, label=folder.name) if count[group.label] > 1 else group
        for group, folder in zip(groups, folders, strict=True)
    ]


def _split_by_number(texts: tuple[str, ...], members: list[tuple[Path, list[str]]]) -> list[FileGroup]:
    count = len(texts) - 1
    values = [{int(digits[place]) for _, digits in members} for place in range(count)]
    varying = [place for place in range(count) if len(values[place]) > 1]
    if not count:
        return [FileGroup(texts[0], {0: path}) for path, _ in members]
    if len(varying) > 1:
        # Use the last number; files that differ in another number are separate kinds, so that shots are not mixed.
        shots: defaultdict[tuple[str, ...], list[tuple[Path, list[str]]]] = defaultdict(list)
        for path, digits in members:
            shots[tuple(digits[:-1])].append((path, digits))
        return [group for own in shots.values() for group in _split_by_number(texts, own)]
    place = varying[0] if varying else count - 1
    files: dict[int, Path] = {}
    for path, digits in members:
        other = files.setdefault(int(digits[place]), path)
        if other != path:
            raise InputError(f"{path}: expected one file a frame, found {other.name} as well; remove one")
    digits = members[0][1]
    words = [text + (digits[i] if i < count and i != place else " ") for i, text in enumerate(texts)]
    return [FileGroup("".join(words).strip(" ._-"), dict(sorted(files.items())))]


def with_stills(groups: list[FileGroup]) -> list[FileGroup]:
    """Add stills with other numbering: `albedo.exr` beside `render_0007.exr` belongs to that frame."""
    if len(groups) > 1 and all(len(group.files) == 1 for group in groups):
        numbers = {number for group in groups for number in group.files} - {0}
        if len(numbers) == 1:
            (number,) = numbers
            return [FileGroup(group.label, {number: path}) for group in groups for path in group.files.values()]
    return groups


def _oidn_groups(found: Iterable[tuple[Path, re.Match[str]]]) -> list[FileGroup]:
    """One kind per buffer; the image with the most samples is the reference, that with the fewest is denoised."""
    shots: defaultdict[str, dict[str, dict[int, Path]]] = defaultdict(lambda: defaultdict(dict))
    for path, match in found:
        shots[match["name"]][match["buffer"].lower()][int(match["samples"])] = path
    kinds: defaultdict[str, dict[int, Path]] = defaultdict(dict)
    for number, (_, buffers) in enumerate(sorted(shots.items())):
        for buffer, files in buffers.items():
            least, most = min(files), max(files)
            kinds[buffer][number] = files[least]
            if most > least and buffer == "hdr":
                kinds["reference"][number] = files[most]
    return [FileGroup(label, files) for label, files in kinds.items()]


def files_beside(path: Path) -> dict[str, Path]:
    """The other images in a file's folder whose names have the same digits, by the rest of their names."""
    digits = _DIGITS.findall(path.stem)
    others = [other for other in _images_in(path.parent) if _DIGITS.findall(other.stem) == digits and other != path]
    return {" ".join(_DIGITS.split(other.stem)[::2]).strip(" ._-"): other for other in others}


def patterns_of(groups: Sequence[FileGroup]) -> list[str]:
    """The file names of all kinds, behind the name of the folder where several have the same."""
    patterns = [pattern_of(group) for group in groups]
    return [
        f"{group.first.parent.name}/{pattern}" if patterns.count(pattern) > 1 else pattern
        for group, pattern in zip(groups, patterns, strict=True)
    ]


def pattern_of(group: FileGroup) -> str:
    """The file names of a kind, with # for the digits of the frame number."""
    path = group.first
    digits = list(_DIGITS.finditer(path.stem))
    if len(group.files) > 1:
        for place in range(len(digits) - 1, -1, -1):
            found = [(number, _DIGITS.findall(each.stem)[place : place + 1]) for number, each in group.files.items()]
            if all(own and int(own[0]) == number for number, own in found):
                start, end = digits[place].span()
                return f"{path.name[:start]}{'#' * (end - start)}{path.name[end:]}"
    return path.name
