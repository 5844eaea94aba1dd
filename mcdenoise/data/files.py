"""Writing files so that a file with its final name is always complete."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from mcdenoise.errors import InputError


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Give a temporary path beside ``path`` to write to, and rename it to ``path`` if the block succeeds.

    A reader of ``path`` sees the old file or the whole new one; if the block fails or is interrupted, the temporary
    file is removed.

    Args:
        path: the file to be written. Its folder must exist.

    Yields:
        A path in the same folder with the same suffix.

    Raises:
        InputError: ``path`` is something other than a file, or the operating system refused to write.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "numbers.txt"
        >>> with atomic_path(path) as temporary:
        ...     _ = temporary.write_text("1 2 3")
        >>> path.read_text(), len(list(path.parent.iterdir()))
        ('1 2 3', 1)
    """
    # Renaming must replace what a link points to, not the link, and never a device such as /dev/stdout.
    target = Path(os.path.realpath(path))
    if os.path.lexists(target) and not os.path.isfile(path):
        raise InputError(f"{path}: expected a file to write, found a folder or a device; choose another path")
    temporary = target.with_name(f".{target.name}.{os.getpid()}.tmp{target.suffix}")
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise InputError(
            f"{path}: cannot be written ({reason}); check the folder, its permissions and free space"
        ) from error
    finally:
        # Gone already after a successful rename; a folder that refuses this refused the file too.
        with suppress(OSError):
            os.unlink(temporary)


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file, whole or not at all.

    Args:
        path: the file to be written. Its folder must exist.
        text: its content.

    Raises:
        InputError: the file cannot be written.
    """
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
