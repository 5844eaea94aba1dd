"""Copying EXR attributes that OpenEXR's Python module cannot represent.

The module fails on text in Latin-1 or Shift-JIS, and on some attribute types. A copy of the file holds a placeholder
text of the same length for each such attribute, and the original bytes are put back into the written file.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

_MULTI_PART = 0x1000
_TEXTS = {b"string", b"stringvector"}
# Attribute types that the module does not know, or drops.
_UNKNOWN = {b"bytes", b"deepImageState", b"idmanifest"}


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
    strange: dict[tuple[int, bytes], bytes] = {}
    with source.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        found = [each for each in records(content) if _is_strange(each, content)]
        if found:
            pixels = bytearray(content)
            for part, name, _, start, _, end in found:
                strange[part, name] = content[start:end]
                rest = end - start - len(name) - len(b"\0string\0....")
                text = name + b"\0string\0" + rest.to_bytes(4, "little") + b"." * rest
                pixels[start:end] = text
    if not strange:
        yield source, strange
        return
    try:
        copy.write_bytes(pixels)
        del pixels
        yield copy, strange
    finally:
        with suppress(OSError):
            os.unlink(copy)


def put_back(target: Path, strange: dict[tuple[int, bytes], bytes]) -> None:
    """Replace placeholder records by the original ones."""
    with target.open("r+b") as file, mmap.mmap(file.fileno(), 0) as content:
        for part, name, _, start, _, end in list(records(content)):
            record = strange.get((part, name))
            if record is not None and len(record) == end - start:
                content[start:end] = record


def _is_strange(record: Record, content: mmap.mmap) -> bool:
    if record.kind in _UNKNOWN:
        return True
    if record.kind not in _TEXTS:
        return False
    try:
        content[record.value : record.end].decode()
    except UnicodeDecodeError:
        return True
    return False
