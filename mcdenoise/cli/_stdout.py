"""Standard output whose failure does not interrupt the work of a command."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO

from mcdenoise.errors import InputError


class _Forgiving:
    """A stream that discards output after a failed write; the first failure is stored.

    Args:
        stream: the stream of a file, whose descriptor is redirected to the null device after a failure.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.failure: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except OSError as error:
            self._failed(error)
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except OSError as error:
            self._failed(error)

    def _failed(self, error: OSError) -> None:
        self.failure = self.failure or error
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, self._stream.fileno())
        os.close(null)
        # Discard the content of its buffer too.
        with suppress(OSError):
            self._stream.flush()


@contextmanager
def forgiving_stdout() -> Iterator[None]:
    """Let a command continue when the reader of its output ends (``| head``), and escape unencodable characters.

    Raises:
        InputError: at the end, if writing failed for another reason, such as a full disk.
    """
    stdout = sys.stdout
    # Leave a stream alone with which other code has replaced stdout.
    if stdout is not sys.__stdout__ or stdout is None:
        yield
        return
    # Like Python's stderr, escape characters that the encoding lacks.
    stdout.reconfigure(errors="backslashreplace")
    sys.stdout = forgiving = _Forgiving(stdout)
    try:
        yield
    finally:
        forgiving.flush()
        sys.stdout = stdout
    if forgiving.failure is not None and not isinstance(forgiving.failure, BrokenPipeError):
        reason = forgiving.failure.strerror
        raise InputError(
            f"standard output: cannot be written ({reason}); everything else is done"
        ) from forgiving.failure
