"""Standard output whose failure does not interrupt the work of a command."""

from __future__ import annotations

import errno
import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from mcdenoise.errors import InputError


class _Forgiving(io.FileIO):
    """A file whose descriptor is that of the null device after a failed write; the first failure is stored."""

    failure: OSError | None = None

    def write(self, content: Any) -> int:
        try:
            if (written := super().write(content)) is not None:
                return written
            raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        except OSError as error:
            self.failure = self.failure or error
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, self.fileno())
        os.close(null)
        return memoryview(content).nbytes


@contextmanager
def forgiving_stdout() -> Iterator[None]:
    """Let a command continue when the reader of its output ends (``| head``), and escape unencodable characters.

    Raises:
        InputError: at the end, if writing failed for another reason, such as a full disk.
    """
    stdout = sys.stdout
    # Leave a stream alone with which other code has replaced stdout, and a console that is no file.
    if stdout is not sys.__stdout__ or not isinstance(stdout, io.TextIOWrapper):
        yield
        return
    if not isinstance(getattr(stdout.buffer, "raw", stdout.buffer), io.FileIO):
        yield
        return
    file = _Forgiving(stdout.fileno(), "wb", closefd=False)
    # Like Python's stderr, escape characters that the encoding lacks.
    sys.stdout = forgiving = io.TextIOWrapper(
        io.BufferedWriter(file), stdout.encoding, "backslashreplace", line_buffering=stdout.line_buffering
    )
    forgiving.reconfigure(write_through=stdout.write_through)
    try:
        yield
    finally:
        forgiving.flush()
        sys.stdout = stdout
    if file.failure is not None and not isinstance(file.failure, BrokenPipeError):
        reason = file.failure.strerror
        raise InputError(f"standard output: cannot be written ({reason}); everything else is done") from file.failure
