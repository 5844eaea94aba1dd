"""What is written down of each finished frame, so that it is known again: by what it was made of, not by its name.

A frame is known by its key, a digest of the bytes of its files and of those of the frames that it remembers, of the
settings, the weights and the version. Beside it stand size and time of each file, as version control systems have them:
where these are the same, the bytes are not read again, and a look costs one question to the file system.
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

from mcdenoise.denoiser import FrameReport
from mcdenoise.errors import InputError
from mcdenoise.models import Stage

# Path, size, time of the last change in nanoseconds.
Stamp = tuple[str, int, int]
_BLOCK, _REMEMBERED = 1 << 20, 256


@dataclass(frozen=True)
class FrameRecord:
    """A frame that is finished.

    Args:
        number: of the frame.
        key: of what it was made.
        result: the file that was written, by its path in the folder of the shot.
        inputs: of each file that it was made of the stamp, and the digest of its bytes.
        report: what happened to it.
        alike: whether it looks like the frame before and finds no history in it.
        change: how far it differs from the result before, in [0, 1]; ``None`` where there was none.
        at: seconds since 1970.
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
        """As JSON, in one line."""
        return json.dumps(asdict(self))

    @classmethod
    def of(cls, line: str) -> FrameRecord | None:
        """What a line says; ``None`` of one that is something else, such as one that was cut off."""
        try:
            found: dict[str, Any] = json.loads(line)
            report = found["report"]
            report["stages"] = {name: Stage(**stage) for name, stage in report["stages"].items()}
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
        OSError: it is not there.
    """
    status = os.stat(path)
    return str(path), status.st_size, status.st_mtime_ns


class Digests:
    """Digests of files, each computed once for a stamp.

    What is computed is remembered of the last files only, of which some are part of many frames; what was written down,
    as long as this lives.
    """

    def __init__(self) -> None:
        self._written: dict[Stamp, str] = {}
        self._computed: dict[Stamp, str] = {}

    def of(self, path: Path) -> tuple[Stamp, str]:
        """Stamp and digest; of a file that cannot be read the digest is empty."""
        try:
            found = stamp(path)
            digest = self._written.get(found) or self._computed.pop(found, "") or digest_of(path)
            # Last in the order of the dictionary, of which the first go.
            self._computed[found] = digest
            if len(self._computed) > _REMEMBERED:
                del self._computed[next(iter(self._computed))]
            return found, digest
        except OSError:
            return (str(path), -1, -1), ""

    def learn(self, records: Iterable[FrameRecord]) -> None:
        """Believe what was written down."""
        for record in records:
            self._written.update(record.inputs)


def digest_of(path: Path) -> str:
    """SHA-256 of a file's bytes.

    Raises:
        OSError: it cannot be read.
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
    """What one process has finished, a line a frame.

    No two processes write to one, not even one that is thought to be dead and its successor.

    Args:
        path: of the file; its folder is made.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    @contextmanager
    def open(self) -> Iterator[Journal]:
        """Within this, lines are written.

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
        """Write down a finished frame.

        Raises:
            InputError: it cannot be written.
        """
        self._write(record.line())

    def _write(self, line: str) -> None:
        # The line before may have been cut off by a full disk.
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
    """The records of one journal; none where it cannot be read."""
    with suppress(OSError), path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            if (record := FrameRecord.of(line)) is not None:
                yield record


class Tail:
    """Counts what is written to a journal while somebody else writes it.

    Args:
        path: of the journal, which need not be there yet.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._offset = 0

    def new(self) -> int:
        """How many frames were finished since the last call."""
        try:
            with self.path.open("rb") as file:
                file.seek(self._offset)
                content = file.read()
        except OSError:
            return 0
        # What is being written is counted next time.
        whole = content.rfind(b"\n") + 1
        self._offset += whole
        return sum(line.startswith(b'{"number"') for line in content[:whole].split(b"\n"))
