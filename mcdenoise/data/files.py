"""Writing files so that a file with its final name is always complete."""

from __future__ import annotations

import os
import platform
import secrets
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from mcdenoise.errors import InputError
from mcdenoise.interruption import unfinished

try:
    import fcntl
except ImportError:
    # A system without such locks: what is left over there stays.
    fcntl = None  # type: ignore[assignment]

# What is being written has names that nothing else has, and is locked by whoever writes it.
_PREFIX, _MARK = ".mcdenoise-", ".tmp"
_YOUNG = 1.0  # seconds
# Folders in which this process has looked for what others left over.
_swept: set[str] = set()


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Give a temporary path beside ``path`` to write to, and rename it to ``path`` if the block succeeds.

    A reader of ``path`` sees the old file or the whole new one, also after a power cut; if the block fails or is
    interrupted, the temporary file is removed, and if the process is killed, the next one that writes to the folder
    removes it. Several processes, on whatever machines, may write to one folder.

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
    # By its suffix a library tells the format: that of the name it was given, not of what that may be a link to.
    temporary = target.with_name(f"{_PREFIX}{secrets.token_hex(8)}{_MARK}{path.suffix[:64]}")
    handle = -1
    try:
        with unfinished(temporary), _writing(path):
            _sweep(target.parent)
            handle = os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)
            _lock(handle)
            yield temporary
            _to_disk(temporary)
            os.replace(temporary, target)
    finally:
        # Gone already after a successful rename; a folder that refuses this refused the file too.
        with suppress(OSError):
            os.unlink(temporary)
        with suppress(OSError):
            os.close(handle)


@contextmanager
def held(folder: Path, work: str) -> Iterator[None]:
    """Have a folder for oneself; that ends with the process, however that ends.

    Args:
        folder: where the lock is put, which nobody needs to remove.
        work: what is done there, one word, for the message.

    Raises:
        InputError: another process has it, which the message names; or the lock cannot be written.

    Example:
        >>> import tempfile
        >>> with held(Path(tempfile.mkdtemp()), "training"):
        ...     pass
    """
    path = folder / ".lock"
    with _writing(path):
        file = path.open("a+", encoding="utf-8")
    with file:
        if fcntl is not None:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                file.seek(0)
                raise InputError(
                    f"{folder}: expected a folder that no other {work} writes to, found {file.read(200).strip()}; "
                    "wait for it, or choose another folder"
                ) from error
        with _writing(path):
            file.truncate(0)
            file.write(f"process {os.getpid()} of {platform.node()} at work in it")
            file.flush()
        yield


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
    temporary = path.absolute().with_name(f"{_PREFIX}{secrets.token_hex(8)}{_MARK}")
    handle = -1
    try:
        with unfinished(temporary), _writing(path):
            temporary.mkdir(parents=True)
            handle = os.open(temporary, os.O_RDONLY)
            _lock(handle)
            _sweep(temporary.parent)
            yield temporary
            # Over a folder that has come meanwhile, unless it is empty, this fails.
            os.rename(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        with suppress(OSError):
            os.close(handle)


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


def check_writable(path: Path) -> None:
    """See that a file can be written, and change nothing: before work of hours, not after it.

    Args:
        path: the file. Its folder must exist.

    Raises:
        InputError: as :func:`atomic_path`.
    """
    with suppress(_Tried), atomic_path(path):
        raise _Tried


class _Tried(Exception):
    """Writing would have begun."""


def remove(path: Path) -> None:
    """Remove a file, if it is there.

    Raises:
        InputError: it is no file, or the operating system refused.
    """
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise InputError(
            f"{path}: expected to replace it, found what cannot be removed ({reason}); check the folder and its "
            "permissions, or choose another"
        ) from error


def _lock(handle: int) -> bool:
    """Hold an open file or folder until it is closed, or the process ends; false if another process holds it."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        # Held, or on a file system without locks.
        return False
    return True


def _sweep(folder: Path) -> None:
    if (place := os.path.realpath(folder)) not in _swept:
        _swept.add(place)
        sweep(folder)


def sweep(folder: Path, youngest: float = _YOUNG) -> None:
    """Remove what processes left over in a folder that were killed while they wrote: nobody holds it any more.

    Args:
        folder: which need not be there.
        youngest: seconds since the last change; 0 where nobody writes to the folder now.
    """
    place = os.path.realpath(folder)
    with suppress(OSError), os.scandir(place) as entries:
        for entry in entries:
            ours = entry.name.startswith(_PREFIX) and _MARK in entry.name
            # What another process has only just made it may not hold yet.
            if ours and abs(time.time() - entry.stat(follow_symlinks=False).st_mtime) >= youngest:
                _remove_unless_held(entry.path)


def _remove_unless_held(path: str) -> None:
    with suppress(OSError):
        # Opened in this way a pipe of the same name would not wait for anybody.
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW)
        try:
            if _lock(handle):
                if os.path.isdir(path):
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    os.unlink(path)
        finally:
            os.close(handle)


def _to_disk(path: Path) -> None:
    """Wait until what was written is on the disk: without that, a power cut after the renaming leaves an empty file."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


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
