"""Keeps a command working if its standard output cannot be written."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO

from mcdenoise.errors import InputError


class _Forgiving:
    """A stream that ignores write errors and stores the first one.

    Args:
        stream: stream of a file; after an error its descriptor is redirected to nowhere, so that later writes succeed.
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
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self._stream.fileno())
        os.close(nowhere)
        # Its buffered contents are discarded there.
        with suppress(OSError):
            self._stream.flush()


@contextmanager
def forgiving_stdout() -> Iterator[None]:
    """Ignore closed pipes, such as ``| head``, inside this block, and escape characters that the encoding lacks.

    Raises:
        InputError: at the end, if the output could not be written for another reason, such as a full disk.
    """
    stdout = sys.stdout
    # Another stream has been installed by the caller.
    if stdout is not sys.__stdout__ or stdout is None:
        yield
        return
    # Like Python's stderr: characters that the encoding lacks are printed as escapes.
    stdout.reconfigure(errors="backslashreplace")
    sys.stdout = forgiving = _Forgiving(stdout)
    try:
        yield
    finally:
        forgiving.flush()
        sys.stdout = stdout
    if forgiving.failure is not None and not isinstance(forgiving.failure, BrokenPipeError):
        reason = forgiving.failure.strerror
        raise InputError(f"standard output: cannot be written ({reason}); all else is done") from forgiving.failure
