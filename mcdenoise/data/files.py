"""Atomic writing: a file with its final name is always complete."""

from __future__ import annotations

import json
import math
import os
import platform
import secrets
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from mcdenoise.errors import InputError
from mcdenoise.interruption import unfinished

try:
    import fcntl
except ImportError:
    # On a system without such locks, leftovers are not removed.
    fcntl = None  # type: ignore[assignment]

# Incomplete files have unique names, and are locked by the process that writes them.
_PREFIX, _MARK = ".mcdenoise-", ".tmp"
_YOUNG = 1.0  # seconds
# Folders that this process has already cleaned of leftovers.
_swept: set[str] = set()


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path``, and rename it to ``path`` if the block succeeds.

    A reader of ``path`` sees the old file or the complete new one, also after a power failure. If the block fails or is
    interrupted, the temporary file is removed; if the process is killed, the next process that writes to the folder
    removes it. Several processes, also on different machines, may write to one folder.

    Args:
        path: the file. Its folder must exist.

    Yields:
        A path in the same folder with the same suffix.

    Raises:
        InputError: ``path`` is not a file, or the operating system refuses to write.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "numbers.txt"
        >>> with atomic_path(path) as temporary:
        ...     _ = temporary.write_text("1 2 3")
        >>> path.read_text(), len(list(path.parent.iterdir()))
        ('1 2 3', 1)
    """
    # Replace the target of a link, not the link, and never a device such as /dev/stdout.
    target = Path(os.path.realpath(path))
    if os.path.lexists(target) and not os.path.isfile(path):
        raise InputError(f"{path}: expected a file to write, found a folder or a device; choose another path")
    # Libraries choose the format by the suffix, so keep that of the given name, not of the link's target.
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
        # After a successful rename it no longer exists. A folder that forbids removing has also forbidden creating it.
        with suppress(OSError):
            os.unlink(temporary)
        with suppress(OSError):
            os.close(handle)


@contextmanager
def held(folder: Path, work: str) -> Iterator[None]:
    """Lock a folder for this process; the lock is released when the process ends in any way.

    Args:
        folder: folder that gets the lock file; that of a killed process is taken over.
        work: the kind of work, one word, for the message.

    Raises:
        InputError: another process holds the lock (the message names it), or the lock file cannot be written.

    Example:
        >>> import tempfile
        >>> with held(Path(tempfile.mkdtemp()), "training"):
        ...     pass
    """
    path = folder / ".lock"
    with _locked(path, folder, work) as file:
        with _writing(path):
            file.truncate(0)
            file.write(f"process {os.getpid()} of {platform.node()} at work in it")
            file.flush()
        try:
            yield
        finally:
            if fcntl is not None:
                with suppress(OSError):
                    path.unlink()


def _locked(path: Path, folder: Path, work: str) -> IO[str]:
    """Open and lock a lock file."""
    while True:
        with _writing(path):
            file = path.open("a+", encoding="utf-8")
        if fcntl is None:
            return file
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # The process that held the lock may have removed its file after this one had opened it.
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                    return file
            file.close()
        except BlockingIOError as error:
            with file:
                file.seek(0)
                raise InputError(
                    f"{folder}: expected a folder that no other {work} writes to, found {file.read(200).strip()}; "
                    "wait for it, or choose another folder"
                ) from error


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder beside ``path``, and rename it to ``path`` if the block succeeds.

    If ``path`` is an empty folder, the temporary folder is in it, and its contents are moved to ``path``, which may be
    a link, the working folder or another disk. If the block fails or is interrupted, the temporary folder is removed
    with its contents.

    Args:
        path: the folder to create; nothing but an empty folder may exist there.

    Yields:
        An empty folder.

    Raises:
        InputError: ``path`` exists and is no empty folder, or the operating system refuses to write.
    """
    exists = path.is_dir()
    with _writing(path):
        if exists:
            _sweep(path)
        if os.listdir(path) if exists else os.path.lexists(path):
            raise InputError(
                f"{path}: expected a new or an empty folder, found {'files in it' if exists else 'a file'}; choose "
                "another folder, or remove what is there"
            )
    temporary = (path if exists else path.parent).absolute() / f"{_PREFIX}{secrets.token_hex(8)}{_MARK}"
    handle = -1
    try:
        with unfinished(temporary), _writing(path):
            temporary.mkdir(parents=True)
            handle = os.open(temporary, os.O_RDONLY)
            _lock(handle)
            _sweep(temporary.parent)
            yield temporary
            if exists:
                for name in os.listdir(temporary):
                    os.rename(temporary / name, path / name)
            else:
                # This fails if a non-empty folder has been created there in the meantime.
                os.rename(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        with suppress(OSError):
            os.close(handle)


def make_folder(path: Path) -> None:
    """Create a folder for results, if it does not exist.

    Raises:
        InputError: that is impossible.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: expected a folder that can be written to, found: {error.strerror}") from error


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file atomically.

    Args:
        path: the file. Its folder must exist.
        text: the content.

    Raises:
        InputError: the file cannot be written.
    """
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, content: Any) -> None:
    """Write a JSON file atomically, see :func:`json_text`.

    Raises:
        InputError: the file cannot be written.
    """
    write_text(path, json_text(content, indent=1) + "\n")


def json_text(content: Any, indent: int | None = None) -> str:
    """The JSON of a content; NaN and infinities, which JSON does not have, are null.

    Example:
        >>> json_text({"error": [0.5, float("nan")]})
        '{"error": [0.5, null]}'
    """
    return json.dumps(_without_nan(content), indent=indent, allow_nan=False)


def _without_nan(content: Any) -> Any:
    if isinstance(content, dict):
        return {name: _without_nan(value) for name, value in content.items()}
    if isinstance(content, list | tuple):
        return [_without_nan(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def check_writable(path: Path) -> None:
    """Check that a file can be written, without changing anything, before hours of work.

    Args:
        path: the file. Its folder must exist.

    Raises:
        InputError: see :func:`atomic_path`.
    """
    with suppress(_Tried), atomic_path(path):
        raise _Tried


class _Tried(Exception):
    """Raised in place of writing, by :func:`check_writable`."""


def remove(path: Path) -> None:
    """Remove a file if it exists.

    Raises:
        InputError: it is not a file, or the operating system refuses.
    """
    with _writing(path):
        path.unlink(missing_ok=True)


def _lock(handle: int) -> bool:
    """Lock an open file or folder until it is closed; return false if another process has locked it."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        # Already locked, or on a file system without locks.
        return False
    return True


def _sweep(folder: Path) -> None:
    if (place := os.path.realpath(folder)) not in _swept:
        _swept.add(place)
        sweep(folder)


def sweep(folder: Path, youngest: float = _YOUNG) -> None:
    """Remove temporary files of killed processes from a folder: those that no process has locked.

    Args:
        folder: the folder; it need not exist.
        youngest: smallest age in seconds; 0 if no process is writing to the folder now.
    """
    place = os.path.realpath(folder)
    with suppress(OSError), os.scandir(place) as entries:
        for entry in entries:
            ours = entry.name.startswith(_PREFIX) and _MARK in entry.name
            # A process may not yet have locked a file that it has just created.
            if ours and abs(time.time() - entry.stat(follow_symlinks=False).st_mtime) >= youngest:
                _remove_unless_held(entry.path)


def _remove_unless_held(path: str) -> None:
    with suppress(OSError):
        # Opened without blocking, in case a pipe has this name.
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
    """Flush a file to the disk; otherwise a power failure after the rename could leave an empty file."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Convert errors of the operating system to an ``InputError``."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise InputError(
            f"{path}: cannot be written ({reason}); check the folder, its permissions and free space"
        ) from error
