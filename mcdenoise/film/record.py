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
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from mcdenoise.errors import InputError
from mcdenoise.light import Repairs
from mcdenoise.models import FrameReport, Stage

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

    def line(self) -> str:
        """The record as one line of JSON, with a checksum of all else at its end."""
        content = asdict(self)
        return json.dumps({**content, "seal": digest_text(json.dumps(content))})

    @classmethod
    def of(cls, line: str) -> FrameRecord | None:
        """The record of a line; ``None`` if the line is no record, or was damaged or cut off."""
        try:
            found: dict[str, Any] = json.loads(line)
            if found.pop("seal") != digest_text(json.dumps(found)):
                return None
            report = found["report"]
            report["stages"] = {name: Stage(**stage) for name, stage in report["stages"].items()}
            filled, limited, clamped, negative, gained, place = report["repairs"]
            report["repairs"] = Repairs(filled, limited, clamped, negative, gained, tuple(place))
            inputs = tuple((_stamp(stamp), str(digest)) for stamp, digest in found["inputs"])
            own = {**found, "result": _stamp(found["result"]), "inputs": inputs, "report": FrameReport(**report)}
            return cls(**own)
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError):
            return None


def _stamp(found: Any) -> Stamp:
    path, size, changed = found
    return str(path), int(size), int(changed)


def stamp(path: Path) -> Stamp:
    """The stamp of a file.

    Raises:
        OSError: there is no such file.
    """
    status = os.stat(path)
    return str(path), status.st_size, status.st_mtime_ns


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
    """SHA-256 of the bytes of a file.

    Raises:
        OSError: the file cannot be read.
    """
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest_text(*parts: str) -> str:
    """SHA-256 of texts."""
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


class Journal:
    """The records of one attempt at a piece, a line a frame.

    Each attempt has a journal of its own: a worker that is taken for lost may still write to its own.
    """

    def __init__(self, path: Path, handle: int) -> None:
        self.path = path
        self._handle = handle

    @classmethod
    @contextmanager
    def open(cls, path: Path) -> Iterator[Journal]:
        """Create a journal, and its folder, for the duration of a ``with`` block.

        Raises:
            InputError: the file cannot be written.
        """
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            handle = os.open(path, os.O_CREAT | os.O_WRONLY | os.O_APPEND, 0o666)
        except OSError as error:
            raise _refused(path, error.strerror) from error
        try:
            yield cls(path, handle)
        finally:
            os.close(handle)

    def add(self, record: FrameRecord) -> None:
        """Add the record of a finished frame.

        Raises:
            InputError: the file cannot be written.
        """
        # A full disk may have cut off the line before.
        content = f"\n{record.line()}\n".encode()
        try:
            if os.write(self._handle, content) < len(content):
                raise _refused(self.path, "it is cut off")
        except OSError as error:
            raise _refused(self.path, error.strerror) from error


def _refused(path: Path, reason: str | None) -> InputError:
    return InputError(f"{path}: cannot be written ({reason}); check the folder and the free space")


def read_records(folder: Path) -> dict[int, FrameRecord]:
    """The last record of each frame in the journals of a folder, by number."""
    found: dict[int, FrameRecord] = {}
    for path in sorted(folder.glob("*.jsonl")):
        # A pipe of such a name would be waited for.
        if not path.is_file():
            continue
        with suppress(OSError), path.open(encoding="utf-8", errors="replace") as file:
            for record in filter(None, map(FrameRecord.of, file)):
                if record.number not in found or found[record.number].at <= record.at:
                    found[record.number] = record
    return found


class Counter:
    """Counts the frames that a run has finished, while workers add records of them.

    Args:
        folder: of the journals.
        run: the beginning of the names of the journals of this run.
    """

    def __init__(self, folder: Path, run: str) -> None:
        self._folder, self._run = folder, run
        self._read: dict[Path, int] = {}
        self._count = 0

    def count(self) -> int:
        """The number of frames."""
        for path in self._folder.glob(f"{self._run}*.jsonl"):
            with suppress(OSError), path.open("rb") as file:
                file.seek(self._read.get(path, 0))
                content = file.read()
                # A line that is still being written is counted by the next call.
                whole = content.rfind(b"\n") + 1
                self._read[path] = self._read.get(path, 0) + whole
                self._count += sum(line.startswith(b'{"number"') for line in content[:whole].split(b"\n"))
        return self._count
