"""Packed takes: all frames of a short shot in one file, for training.

A file is a zip of numpy arrays (``.npz``), half floats of one axis of frames, and a header in JSON. The bytes of the
halves are stored apart: this takes less space than compressed halves, and is read faster.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import zipfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcdenoise.data.files import atomic_path
from mcdenoise.frame import BUFFERS
from mcdenoise.reading import check_file, expecting

SUFFIX = ".take.npz"
ERROR = "reference_error"
_FORMAT = 1
_LARGEST_HEADER = 1 << 20

Halves = NDArray[np.float16]


@dataclass(frozen=True)
class Shard:
    """A packed take.

    Args:
        path: the file.
        header: how it was rendered, and from what: a JSON object.
        shapes: ``(T, C, H, W)`` of each array; those of the reference have as many frames as there are references,
            which belong to the last frames.
        digest: checksum of the header and of all arrays.
    """

    path: Path
    header: Mapping[str, Any]
    shapes: Mapping[str, tuple[int, int, int, int]]
    digest: str

    def __len__(self) -> int:
        return self.shapes["color"][0]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.shapes["color"][2:]

    @property
    def references(self) -> int:
        """Number of the last frames that have a reference."""
        return self.shapes["reference"][0]

    def read(self, names: Collection[str] | None = None) -> dict[str, Halves]:
        """The arrays of these names, of all by default.

        Raises:
            InputError: the file is damaged or gone.
        """
        with _opened(self.path) as files:
            wanted = {name: shape for name, shape in self.shapes.items() if names is None or name in names}
            return {name: _joined(files, name, shape) for name, shape in wanted.items()}


def write_shard(path: Path, header: Mapping[str, Any], arrays: Mapping[str, NDArray[np.floating[Any]]]) -> None:
    """Write a packed take atomically.

    Args:
        path: the file.
        header: a JSON object.
        arrays: ``(T, C, H, W)`` by the names of buffers; ``reference`` and ``reference_error`` may have fewer frames.
            Values beyond the range of half floats are clamped.

    Raises:
        InputError: it cannot be written.
    """
    limit = float(np.finfo(np.float16).max)
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w") as files:
        shapes = {name: list(array.shape) for name, array in arrays.items()}
        about = {**header, "format": _FORMAT, "shapes": shapes}
        # The time of such an entry is always that of 1980: the same content is the same file.
        files.writestr(zipfile.ZipInfo("header.json"), json.dumps(about, indent=1))
        for name, array in arrays.items():
            finite = np.where(np.isinf(array), array, np.clip(array, -limit, limit))
            planes = np.ascontiguousarray(finite, dtype="<f2").view(np.uint8).reshape(-1, 2)
            for plane in (1, 0):
                entry = zipfile.ZipInfo(f"{name}.{plane}.npy")
                content = io.BytesIO()
                np.save(content, np.ascontiguousarray(planes[:, plane]), allow_pickle=False)
                files.writestr(entry, content.getvalue(), zipfile.ZIP_DEFLATED, compresslevel=4)


def open_shard(path: Path) -> Shard:
    """Read the header of a packed take.

    Raises:
        InputError: it is none, or is damaged.
    """
    with _opened(path) as files:
        with files.open("header.json") as file:
            header = json.loads(file.read(_LARGEST_HEADER))
        checksums = sorted((entry.filename, entry.CRC) for entry in files.infolist())
        shapes = {name: _shape(name, shape) for name, shape in header["shapes"].items()}
        frames, _, *size = shapes["color"]
        for name, (count, _, *own) in shapes.items():
            if own != size or not (count <= frames if name in ("reference", ERROR) else count == frames):
                raise ValueError(f"{name} of another size")
        if header["format"] != _FORMAT or "reference" not in shapes:
            raise ValueError("another format")
    return Shard(path, header, shapes, hashlib.sha256(repr(checksums).encode()).hexdigest())


def find_shards(path: Path) -> list[Path]:
    """The packed takes in a folder, or the one that the path is; none if it is something else."""
    if path.name.endswith(SUFFIX):
        return [path]
    return sorted(path.glob(f"[!.]*{SUFFIX}")) if os.path.isdir(path) else []


def _shape(name: str, shape: Any) -> tuple[int, int, int, int]:
    frames, channels, height, width = (int(side) for side in shape)
    known = BUFFERS["reference" if name == ERROR else name].channels
    if channels != known or min(frames, height, width) < 1 or math.prod((frames, channels, height, width)) > (1 << 30):
        raise ValueError(f"{name} of {frames}x{channels}x{height}x{width} values")
    return frames, channels, height, width


def _joined(files: zipfile.ZipFile, name: str, shape: tuple[int, ...]) -> Halves:
    count = math.prod(shape)
    values = np.empty((count, 2), np.uint8)
    for plane in range(2):
        with files.open(f"{name}.{plane}.npy") as file:
            found = np.lib.format.read_array(file, allow_pickle=False)
            # A read at the end also compares the checksum.
            if found.shape != (count,) or found.dtype != np.uint8 or file.read(1):
                raise ValueError(f"{name} of another length")
            values[:, plane] = found
    return values.view("<f2").reshape(shape).astype(np.float16, copy=False)


@contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    """The zip; whatever goes wrong with it is one line."""
    # zipfile, zlib and numpy raise a dozen different exceptions for damaged data, some with all of the data.
    with expecting(path, "a packed take", (Exception,)):
        check_file(path)
        with zipfile.ZipFile(path) as files:
            yield files
