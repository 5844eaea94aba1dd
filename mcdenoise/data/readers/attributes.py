"""Copying EXR attributes unchanged, whatever OpenEXR's Python module makes of them.

The module fails on text in Latin-1, on a frame rate of 24/0 and on many types. So it gets a copy of the file in which
each attribute that pixels do not need is a placeholder of the same length; the written file gets the original.
"""

from __future__ import annotations

import mmap
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

_MULTI_PART = 0x1000
# The attributes without which a flat image cannot be read and written as it was, and their types.
_NEEDED = {
    **{b"channels": b"chlist", b"compression": b"compression", b"lineOrder": b"lineOrder", b"tiles": b"tiledesc"},
    **{b"dataWindow": b"box2i", b"displayWindow": b"box2i", b"chunkCount": b"int", b"screenWindowCenter": b"v2f"},
    **dict.fromkeys((b"pixelAspectRatio", b"screenWindowWidth", b"dwaCompressionLevel"), b"float"),
    **dict.fromkeys((b"name", b"type"), b"string"),
}


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
def readable(source: Path, copy: Path) -> Iterator[dict[tuple[int, bytes], bytes]]:
    """Write a copy that OpenEXR's Python module can read, for as long as the block lasts.

    Args:
        source: an EXR.
        copy: path of the copy.

    Yields:
        The original records by part and name of the placeholder, for :func:`put_back`.
    """
    originals: dict[tuple[int, bytes], bytes] = {}
    try:
        shutil.copyfile(source, copy)
        with copy.open("r+b") as file, mmap.mmap(file.fileno(), 0) as content:
            for each in list(records(content)):
                # As long as the name was: a file says that it has long ones.
                name = (b"~%d" % len(originals)).ljust(len(each.name), b"~")
                text = name + b"\0string\0"
                rest = each.end - each.start - len(text) - 4
                if rest >= 0 and not _is_needed(each, content):
                    originals[each.part, name] = content[each.start : each.end]
                    content[each.start : each.end] = text + rest.to_bytes(4, "little") + b"." * rest
        yield originals
    finally:
        copy.unlink(missing_ok=True)


def put_back(target: Path, originals: dict[tuple[int, bytes], bytes]) -> None:
    """Replace placeholder records by the original ones."""
    with target.open("r+b") as file, mmap.mmap(file.fileno(), 0) as content:
        for each in list(records(content)):
            content[each.start : each.end] = originals.get((each.part, each.name), content[each.start : each.end])


def _is_needed(record: Record, content: mmap.mmap) -> bool:
    value = content[record.value : record.end]
    is_text = record.kind != b"string" or value.decode(errors="replace").encode() == value
    return _NEEDED.get(record.name) == record.kind and is_text
