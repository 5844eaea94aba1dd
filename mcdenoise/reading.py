"""Safe reading of files from users, which may be anything."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from mcdenoise.errors import InputError

# Far larger than any valid text file of the package.
LARGEST_TEXT = 64 << 20
# Some system files report a size of zero but have contents.
_UNSAID = 1 << 20
# Characters of a parser's message, which may quote the file.
_LONGEST = 300


def check_file(path: Path) -> None:
    """Check that a path is a regular file: opening a pipe would block, and a device has no end.

    Raises:
        OSError: it is not; ``strerror`` says what it is.
    """
    if os.path.islink(path) and not os.path.exists(path):
        raise OSError(errno.ENOENT, "it is a link to nothing", str(path))
    mode = os.stat(path).st_mode
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "it is a folder" if stat.S_ISDIR(mode) else "it is a device or a pipe", str(path))


def read_bytes(path: Path, largest: int = LARGEST_TEXT) -> bytes:
    """Read a file of at most ``largest`` bytes.

    Raises:
        OSError: see :func:`check_file`; or the file is larger, or cannot be read.
    """
    check_file(path)
    # Do not block even if the file was replaced by a pipe in the meantime.
    with open(os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0)), "rb") as file:
        size = os.fstat(file.fileno()).st_size
        # ``read`` allocates the requested size at once, so request no more than the file's size.
        if size <= largest and len(content := file.read(min(largest, max(size, _UNSAID)) + 1)) <= largest:
            return content
    raise OSError(errno.EFBIG, f"it is larger than {largest} bytes", str(path))


def read_text(path: Path, largest: int = LARGEST_TEXT, errors: str = "strict") -> str:
    """Read a UTF-8 file of at most ``largest`` bytes.

    Raises:
        OSError: see :func:`read_bytes`.
        UnicodeDecodeError: the file is not valid UTF-8.
    """
    return read_bytes(path, largest).decode("utf-8", errors)


@contextmanager
def expecting(
    path: Path, what: str, errors: tuple[type[Exception], ...] = (OSError, ValueError, RecursionError)
) -> Iterator[None]:
    """Read and parse a file inside this block: whatever is wrong with it is one line.

    Args:
        path: the file, for the message.
        what: what it should be.
        errors: what reading and parsing raise.

    Raises:
        InputError: raised in the block, or in place of one of ``errors``.
    """
    try:
        yield
    except InputError:
        raise
    except errors as error:
        said = getattr(error, "strerror", None) or str(error) or type(error).__name__
        found = " ".join(said.split())[:_LONGEST]
        raise InputError(f"{path}: expected {what}, found: {found}; check the path and what is there") from error
