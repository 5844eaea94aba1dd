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
import platform
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from mcdenoise.errors import InputError
from mcdenoise.light import Repairs
from mcdenoise.models import FrameReport, Stage

# Path, size, time of the last change in nanoseconds; a time of -1 is that of no file.
Stamp = tuple[str, int, int]
# Nanoseconds, the largest step of the clock of a file system.
_YOUNG = 2_000_000_000
_BLOCK, _REMEMBERED = 1 << 20, 256


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


class Digests:
    """Digests of files, cached by their stamps.

    The cache holds the digests of all records that it was given, and of the last 256 files that it has read.
    """

    def __init__(self) -> None:
        self._recorded: dict[Stamp, str] = {}
        self._computed: dict[Stamp, str] = {}

    def of(self, path: Path) -> tuple[Stamp, str]:
        """Stamp and digest of a file; the digest of a file that cannot be read is empty."""
        try:
            status = os.stat(path)
            # A copy may keep the time of its source, but not that of the last change of its entry.
            changed = max(status.st_mtime_ns, status.st_ctime_ns)
            if time.time_ns() - changed <= _YOUNG:
                return (str(path), status.st_size, -1), digest_of(path)
            found = str(path), status.st_size, changed
            digest = self._recorded.get(found) or self._computed.pop(found, "") or digest_of(path)
            # The newest entry is the last one of the dictionary, and the first one is dropped.
            self._computed[found] = digest
            if len(self._computed) > _REMEMBERED:
                del self._computed[next(iter(self._computed))]
            return found, digest
        except OSError:
            return (str(path), -1, -1), ""

    def learn(self, records: Iterable[FrameRecord]) -> None:
        """Take the digests of records."""
        for record in records:
            self._recorded.update(record.inputs)


def digest_of(path: Path) -> str:
    """SHA-256 of the bytes of a file.

    Raises:
        OSError: the file cannot be read.
    """
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def digest_text(*parts: str) -> str:
    """SHA-256 of texts."""
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


class Journal:
    """The records of one attempt at a piece, a line a frame.

    Each attempt has a journal of its own: a worker that is taken for lost may still write to its own.

    Args:
        path: of the file; its folder is created.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @contextmanager
    def open(self) -> Iterator[Journal]:
        """Open the journal for the duration of a ``with`` block.

        Raises:
            InputError: the file cannot be written.
        """
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._handle = os.open(self.path, os.O_CREAT | os.O_WRONLY | os.O_APPEND, 0o666)
        except OSError as error:
            raise self._refused(error) from error
        try:
            self._write(json.dumps({"process": os.getpid(), "node": platform.node()}))
            yield self
        finally:
            os.close(self._handle)

    def add(self, record: FrameRecord) -> None:
        """Add the record of a finished frame.

        Raises:
            InputError: the file cannot be written.
        """
        self._write(record.line())

    def _write(self, line: str) -> None:
        # A full disk may have cut off the line before.
        content = f"\n{line}\n".encode()
        try:
            if os.write(self._handle, content) < len(content):
                raise InputError(f"{self.path}: cannot be written (it is cut off); check the free space")
        except OSError as error:
            raise self._refused(error) from error

    def _refused(self, error: OSError) -> InputError:
        return InputError(f"{self.path}: cannot be written ({error.strerror}); check the folder and free space")


def read_records(folder: Path) -> dict[int, FrameRecord]:
    """The last record of each frame in the journals of a folder, by number."""
    found: dict[int, FrameRecord] = {}
    for path in sorted(folder.glob("*.jsonl")):
        for record in read_journal(path):
            if record.number not in found or found[record.number].at <= record.at:
                found[record.number] = record
    return found


def read_journal(path: Path) -> Iterator[FrameRecord]:
    """The records of one journal; none if it cannot be read."""
    # A pipe of such a name would be waited for.
    if not path.is_file():
        return
    with suppress(OSError), path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            if (record := FrameRecord.of(line)) is not None:
                yield record


class Tail:
    """Counts the records of a journal while a worker writes it.

    Args:
        path: of the journal, which need not exist yet.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._offset = 0

    def new(self) -> int:
        """The number of frames that were finished since the last call."""
        try:
            with self.path.open("rb") as file:
                file.seek(self._offset)
                content = file.read()
        except OSError:
            return 0
        # A line that is still being written is counted by the next call.
        whole = content.rfind(b"\n") + 1
        self._offset += whole
        return sum(line.startswith(b'{"number"') for line in content[:whole].split(b"\n"))
