"""Copying EXR attributes that OpenEXR's Python module cannot represent.

The module fails on text in Latin-1 or Shift-JIS, on a frame rate of 24/0, on an attribute of the format of another type
than the format says, and on some types. A copy of the file holds a placeholder text of the same length for each such
attribute, and the original bytes are put back into the written file.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

_MULTI_PART = 0x1000
# The types that the module copies, with their sizes in bytes if all values have the same.
_COPIED = {
    **dict.fromkeys((b"string", b"stringvector", b"floatvector", b"chlist")),
    **dict.fromkeys((b"compression", b"lineOrder"), 1),
    **dict.fromkeys((b"int", b"float"), 4),
    **dict.fromkeys((b"double", b"rational", b"timecode", b"v2i", b"v2f"), 8),
    **dict.fromkeys((b"v3i", b"v3f"), 12),
    **dict.fromkeys((b"v2d", b"box2i", b"box2f"), 16),
    **{b"tiledesc": 9, b"v3d": 24, b"chromaticities": 32, b"m33f": 36, b"m44f": 64, b"m33d": 72, b"m44d": 128},
}
# The types of attributes of the format; the module misreads others under these names.
_OF_FORMAT = {
    name: kind
    for kind, names in {
        b"box2i": b"dataWindow displayWindow originalDataWindow sensorAcquisitionRectangle",
        b"float": b"dwaCompressionLevel pixelAspectRatio screenWindowWidth",
        b"int": b"chunkCount",
        b"string": b"name type",
        b"v2f": b"adoptedNeutral cameraColorBalance screenWindowCenter sensorCenterOffset sensorOverallDimensions",
        # Flat images, and no others are read, have none.
        b"": b"version",
    }.items()
    for name in names.split()
} | {name: name for name in (b"chromaticities", b"compression", b"envmap", b"lineOrder", b"preview")}
_OF_FORMAT |= {b"channels": b"chlist", b"tiles": b"tiledesc"}
_ONLY_OF_FORMAT = {b"chlist", b"compression", b"lineOrder", b"tiledesc"}


class Record(NamedTuple):
    """An attribute in the header of a file: name, type, byte count, value.

    Args:
        part: index of the part.
        name: name of the attribute.
        kind: type of the attribute.
        start: file offset of the record.
        value: file offset of the value.
        end: file offset of the record's end.
    """

    part: int
    name: bytes
    kind: bytes
    start: int
    value: int
    end: int


def records(content: bytes | mmap.mmap) -> Iterator[Record]:
    """The attributes of all parts of a file (OpenEXR File Layout, "Header"); ``ValueError`` if it is damaged."""
    several = int.from_bytes(content[4:8], "little") & _MULTI_PART
    place, part = 8, 0
    while content[place]:
        while content[place]:
            name = content.find(b"\0", place)
            kind = content.find(b"\0", name + 1)
            value = kind + 5
            end = value + int.from_bytes(content[kind + 1 : value], "little")
            if not place < name < kind < end < len(content):
                raise ValueError("damaged header")
            yield Record(part, content[place:name], content[name + 1 : kind], place, value, end)
            place = end
        place, part = place + 1, part + 1
        if not several:
            return


@contextmanager
def readable(source: Path, copy: Path) -> Iterator[tuple[Path, dict[tuple[int, bytes], bytes]]]:
    """Yield a file that OpenEXR's Python module can read, and the replaced records.

    Args:
        source: an EXR.
        copy: path for a temporary copy.

    Yields:
        ``source`` itself and nothing, or ``copy`` and the original records by part and name.
    """
    unreadable: dict[tuple[int, bytes], bytes] = {}
    with source.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        found = [each for each in records(content) if _is_unreadable(each, content)]
        if found:
            pixels = bytearray(content)
            for part, name, _, start, _, end in found:
                # A name of the format must not have a text.
                name = b"~" + name[1:] if name in _OF_FORMAT else name
                unreadable[part, name] = content[start:end]
                rest = end - start - len(name) - len(b"\0string\0....")
                if rest < 0:
                    raise ValueError("damaged header")
                text = name + b"\0string\0" + rest.to_bytes(4, "little") + b"." * rest
                pixels[start:end] = text
    if not unreadable:
        yield source, unreadable
        return
    try:
        copy.write_bytes(pixels)
        del pixels
        yield copy, unreadable
    finally:
        with suppress(OSError):
            os.unlink(copy)


def put_back(target: Path, unreadable: dict[tuple[int, bytes], bytes]) -> None:
    """Replace placeholder records by the original ones."""
    with target.open("r+b") as file, mmap.mmap(file.fileno(), 0) as content:
        for part, name, _, start, _, end in list(records(content)):
            record = unreadable.get((part, name))
            if record is not None and len(record) == end - start:
                content[start:end] = record


def _is_unreadable(record: Record, content: mmap.mmap) -> bool:
    name, kind, value = record.name, record.kind, content[record.value : record.end]
    if (
        kind not in _COPIED
        or _OF_FORMAT.get(name, kind) != kind
        or (kind in _ONLY_OF_FORMAT and name not in _OF_FORMAT)
    ):
        return True
    if len(value) != (_COPIED[kind] or len(value)):
        return True
    if kind == b"rational":
        return not any(value[4:])
    try:
        value.decode() if b"string" in kind else b""
    except UnicodeDecodeError:
        return True
    return b"vector" in kind and len(value) <= 4
