"""Reading archives of Open Image Denoise's weights (``.tza``), from files and from inside its library."""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from mcdenoise.errors import InputError
from mcdenoise.reading import check_file, read_bytes

Archive: TypeAlias = dict[str, Tensor]

# Magic number and major version.
_MAGIC = struct.pack("<HB", 0x41D7, 2)
_TYPES: dict[object, str] = {b"f": "<f4", b"h": "<f2"}
# Longest name in bytes.
_LARGEST = 1 << 30
_MOST_TENSORS, _LONGEST_NAME, _MOST_AXES = 1000, 200, 4


def read_tza(path: Path) -> Archive:
    """Read an archive: its tensors by name, in file order, as float32.

    Args:
        path: a file as exported by the training scripts of Open Image Denoise.

    Raises:
        InputError: the file does not exist, is not an archive, or is damaged.
    """
    try:
        content = read_bytes(path, _LARGEST)
    except OSError as error:
        raise InputError(f"{path}: expected an archive of weights, found: {error.strerror}") from error
    if not content.startswith(_MAGIC):
        raise InputError(
            f"{path}: expected an archive of weights of Open Image Denoise (.tza, version 2), found another"
        )
    try:
        return _archive(content, 0)
    except (struct.error, ValueError) as error:
        raise InputError(f"{path}: expected a whole archive of weights, found a damaged one: {error}") from error


def archives_in(path: Path) -> Iterator[Archive]:
    """Find all archives inside a file, such as those compiled into the library.

    Raises:
        InputError: the file cannot be read.
    """
    try:
        check_file(path)
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            at = content.find(_MAGIC)
            while at >= 0:
                # The magic number of three bytes may occur by chance.
                with suppress(struct.error, ValueError):
                    yield _archive(content, at)
                at = content.find(_MAGIC, at + 1)
    except OSError as error:
        raise InputError(f"{path}: expected a library that can be read, found: {error.strerror}") from error


def _archive(content: bytes | mmap.mmap, start: int) -> Archive:
    """Parse magic number, version and table offset, then name, shape, layout, type and offset of each tensor."""
    (table,) = struct.unpack_from("<Q", content, start + 4)
    at = start + table
    (count,) = struct.unpack_from("<I", content, at)
    at += 4
    _check("tensors", count, _MOST_TENSORS)
    found: Archive = {}
    for _ in range(count):
        (length,) = struct.unpack_from("<H", content, at)
        _check("characters of a name", length, _LONGEST_NAME)
        name = content[at + 2 : at + 2 + length].decode("ascii")
        (axes,) = struct.unpack_from("<B", content, at + 2 + length)
        _check("axes", axes, _MOST_AXES)
        at += 3 + length
        *shape, _, kind, place = struct.unpack_from(f"<{axes}I{axes}scQ", content, at)
        at += 4 * axes + axes + 9
        if kind not in _TYPES:
            raise ValueError(f"type {kind!r} of '{name}'")
        size = int(np.prod(shape)) * np.dtype(_TYPES[kind]).itemsize
        values = content[start + place : start + place + size]
        if len(values) < size:
            raise ValueError(f"'{name}' ends before its end")
        found[name] = torch.from_numpy(np.frombuffer(values, _TYPES[kind]).reshape(shape).astype(np.float32))
    return found


def _check(what: str, count: int, most: int) -> None:
    if count > most:
        raise ValueError(f"{count} {what}")
