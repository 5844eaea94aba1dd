"""Records of finished frames, by which the next run knows that they need not be denoised again.

A record has the key of its frame: a digest of the bytes of the frame's files and of the frames in its history, of the
settings, the weights and the version. It also has size and time of the last change of each file, as the index of a
version control system has: a file with the same size and time is not read again, so that a scan costs one stat call a
file. The time of a file that had just changed is not kept, because the next change may have the same one.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

import msgspec

from mcdenoise.models._report import FrameReport
from mcdenoise.reading import read_bytes

# Path, size, time of the last change in nanoseconds; a time of -1 is that of no file.
Stamp = tuple[str, int, int]
# Nanoseconds, the largest step of the clock of a file system.
_YOUNG = 2_000_000_000


@dataclass(frozen=True)
class FrameRecord:
    """The record of a finished frame.

    Args:
        number: of the frame.
        key: digest of all that decides its result.
        result: the file that was written, by its path in the folder of the shot.
        inputs: stamp and digest of each input file.
        report: of the denoiser.
        alike: whether the frame resembles the frame before, and yet finds no history in it.
        change: difference from the result before, in [0, 1]; ``None`` where there was none.
        at: time of the record, seconds since 1970.
    """

    number: int
    key: str
    result: Stamp
    inputs: tuple[tuple[Stamp, str], ...]
    report: FrameReport
    alike: bool = False
    change: float | None = None
    at: float = field(default_factory=time.time)

    def write(self, journal: BinaryIO) -> None:
        """Add the record to a journal, which is not buffered, as one line of JSON."""
        # A full disk may have cut off the line before; a record that is cut off is none, and its frame is made again.
        journal.write(b"\n" + msgspec.json.encode(self) + b"\n")

    def is_there(self, folder: Path) -> bool:
        """Whether its result is in the folder of the shot, as it was written."""
        with suppress(OSError):
            return result_stamp(folder / self.result[0])[1:] == self.result[1:]
        return False


def read_records(folder: Path) -> dict[int, FrameRecord]:
    """The last record of each frame in the journals of a folder, by number."""
    decode = msgspec.json.Decoder(FrameRecord).decode
    found: dict[int, FrameRecord] = {}
    for path in sorted(folder.glob("*.jsonl")):
        with suppress(OSError):
            for line in read_bytes(path).splitlines():
                # Others are cut off, or damaged.
                with suppress(ValueError, RecursionError):
                    record = decode(line)
                    if record.number not in found or found[record.number].at <= record.at:
                        found[record.number] = record
    return found


def result_stamp(path: Path) -> Stamp:
    """Name, size and time of a written file; an ``OSError`` if there is none."""
    status = os.stat(path)
    return path.name, status.st_size, status.st_mtime_ns


def stamp_and_digest(path: Path, recorded: Mapping[Stamp, str]) -> tuple[Stamp, str]:
    """Stamp and digest of a file, which is read only if it is not recorded; no digest of one that cannot be read."""
    try:
        status = os.stat(path)
        # A copy may keep the time of its source, but not that of the last change of its entry.
        changed = max(status.st_mtime_ns, status.st_ctime_ns)
        if time.time_ns() - changed <= _YOUNG:
            return (str(path), status.st_size, -1), digest_of(path)
        found = str(path), status.st_size, changed
        return found, recorded.get(found) or _digest_of(found)
    except OSError:
        return (str(path), -1, -1), ""


# Frames may share a file.
@lru_cache(256)
def _digest_of(file: Stamp) -> str:
    return digest_of(Path(file[0]))


def digest_of(path: Path) -> str:
    """SHA-256 of the bytes of a file, which must be readable."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest_text(*parts: str) -> str:
    """SHA-256 of texts."""
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()
