"""Reading files that people name, or that lie where one looks for them: they may be anything."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

# Far more than any text of ours takes.
LARGEST_TEXT = 64 << 20
# Some files of the system say that they are empty, and are not.
_UNSAID = 1 << 20


def check_file(path: Path) -> None:
    """See that there is a file: a pipe would wait for ever for who writes into it, and a device has no end.

    Raises:
        OSError: there is none; its ``strerror`` says what there is.
    """
    mode = os.stat(path).st_mode
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "it is a folder" if stat.S_ISDIR(mode) else "it is a device or a pipe", str(path))


def read_bytes(path: Path, largest: int = LARGEST_TEXT) -> bytes:
    """What is in a file, of at most so many bytes.

    Raises:
        OSError: as :func:`check_file`; or it is larger, or cannot be read.
    """
    check_file(path)
    # What has become a pipe meanwhile does not wait either.
    with open(os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0)), "rb") as file:
        size = os.fstat(file.fileno()).st_size
        # Memory for all that is asked for is taken at once.
        content = b"" if size > largest else file.read(min(largest, max(size, _UNSAID)) + 1)
        larger = size > largest or len(content) > largest
    if larger:
        raise OSError(errno.EFBIG, f"it is larger than {largest} bytes", str(path))
    return content


def read_text(path: Path, largest: int = LARGEST_TEXT, errors: str = "strict") -> str:
    """The text of a UTF-8 file, of at most so many bytes.

    Raises:
        OSError: as :func:`read_bytes`.
        UnicodeDecodeError: it is no such text.
    """
    return read_bytes(path, largest).decode("utf-8", errors)
