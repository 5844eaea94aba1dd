"""Writing files so that a file with its final name is always complete."""

from __future__ import annotations

import os
import shutil
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
        with _writing(path):
            yield temporary
            os.replace(temporary, target)
    finally:
        # Gone already after a successful rename; a folder that refuses this refused the file too.
        with suppress(OSError):
            os.unlink(temporary)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Give a temporary folder beside ``path`` to write to, and rename it to ``path`` if the block succeeds.

    If the block fails or is interrupted, the temporary folder is removed with all that is in it.

    Args:
        path: the folder to be made; nothing may be there.

    Yields:
        An empty folder in the same place.

    Raises:
        InputError: there is something at ``path``, or the operating system refused to write.
    """
    if os.path.lexists(path):
        raise InputError(f"{path}: expected nothing there yet, found something; choose a new folder, or remove it")
    temporary = path.absolute().with_name(f".{path.absolute().name}.{os.getpid()}.tmp")
    try:
        with _writing(path):
            temporary.mkdir(parents=True)
            yield temporary
            # Over a folder that has come meanwhile, unless it is empty, this fails.
            os.rename(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


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


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """One line for what the operating system refuses."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise InputError(
            f"{path}: cannot be written ({reason}); check the folder, its permissions and free space"
        ) from error
