"""Safe reading of files from users, which may be anything."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

# Far larger than any valid text file of the package.
LARGEST_TEXT = 64 << 20
# Some system files report a size of zero but have contents.
_UNSAID = 1 << 20


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
        content = b"" if size > largest else file.read(min(largest, max(size, _UNSAID)) + 1)
        larger = size > largest or len(content) > largest
    if larger:
        raise OSError(errno.EFBIG, f"it is larger than {largest} bytes", str(path))
    return content


def read_text(path: Path, largest: int = LARGEST_TEXT, errors: str = "strict") -> str:
    """Read a UTF-8 file of at most ``largest`` bytes.

    Raises:
        OSError: see :func:`read_bytes`.
        UnicodeDecodeError: the file is not valid UTF-8.
    """
    return read_bytes(path, largest).decode("utf-8", errors)
