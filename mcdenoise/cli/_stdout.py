"""Standard output that cannot be written to does not end a command's work."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO

from mcdenoise.errors import InputError


class _Forgiving:
    """A stream that takes what is written to it, whether or not it can be handed on; the first failure is kept.

    Args:
        stream: a file's, whose descriptor leads nowhere after a failure, so that no later write meets it again.
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
        # What is in its buffer goes there.
        with suppress(OSError):
            self._stream.flush()


@contextmanager
def forgiving_stdout() -> Iterator[None]:
    """Let a command go on where nobody reads what it prints, such as ``| head``, and print what its encoding lacks.

    Raises:
        InputError: at the end, where it could not be written for another reason, such as a full disk.
    """
    stdout = sys.stdout
    # Another stream is of whoever has put it there.
    if stdout is not sys.__stdout__ or stdout is None:
        yield
        return
    # As Python's own stderr does: a name that ASCII lacks is shown by its number.
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
