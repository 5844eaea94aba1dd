"""Atomic writing: a file with its final name is always complete."""

from __future__ import annotations

import json
import math
import os
import platform
import secrets
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from mcdenoise.errors import InputError
from mcdenoise.interruption import delete, unfinished
from mcdenoise.reading import expecting

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
    target, temporary = _beside(path)
    with _temporary(path, temporary):
        yield temporary
        # Otherwise a power failure after the rename could leave an empty file.
        with temporary.open("rb") as file:
            os.fsync(file)
        os.replace(temporary, target)


@contextmanager
def held(folder: Path, work: str, *, wait: bool = False) -> Iterator[None]:
    """Lock a folder for this process; the lock is released when the process ends in any way.

    Args:
        folder: folder that gets the lock file; that of a killed process is taken over. Created if it does not exist.
        work: the kind of work, one word, for the message.
        wait: whether to wait for a process that holds the lock.

    Raises:
        InputError: another process holds the lock (the message names it), or the lock file cannot be written.

    Example:
        >>> import tempfile
        >>> with held(Path(tempfile.mkdtemp()), "training"):
        ...     pass
    """
    make_folder(folder)
    path = folder / ".lock"
    with ExitStack() as stack:
        while True:
            with writing(path):
                file = stack.enter_context(path.open("a+", encoding="utf-8"))
            if fcntl is not None and not _lock(file.fileno(), wait=wait):
                file.seek(0)
                raise InputError(
                    f"{folder}: expected a folder that no other {work} writes to, found "
                    f"{file.read(200).strip() or 'its lock'}; wait for it, or choose another folder"
                )
            # The process that held the lock may have removed its file after this one had opened it.
            with suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                    break
        with writing(path):
            file.truncate(0)
            file.write(f"process {os.getpid()} of {platform.node()} at work in it")
            file.flush()
        try:
            with unfinished(path):
                yield
        finally:
            if fcntl is not None:
                with suppress(OSError):
                    path.unlink()


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
    with writing(path):
        if exists:
            _sweep(path)
        if os.listdir(path) if exists else os.path.lexists(path):
            raise InputError(
                f"{path}: expected a new or an empty folder, found {'files in it' if exists else 'a file'}; choose "
                "another folder, or remove what is there"
            )
    temporary = (path if exists else path.parent).absolute() / _name()
    with _temporary(path, temporary, folder=True):
        yield temporary
        if exists:
            for name in os.listdir(temporary):
                os.rename(temporary / name, path / name)
        else:
            # This fails if a non-empty folder has been created there in the meantime.
            os.rename(temporary, path)


@contextmanager
def folder_beside(path: Path) -> Iterator[Path]:
    """Yield a temporary folder beside a file that is to be written, and remove it with its contents after the block.

    Args:
        path: the file; its folder is created if it does not exist.

    Raises:
        InputError: the operating system refuses to write there.
    """
    temporary = path.parent.absolute() / _name()
    with _temporary(path, temporary, folder=True):
        yield temporary


def _name() -> str:
    """A name of an incomplete file that no other has."""
    return f"{_PREFIX}{secrets.token_hex(8)}{_MARK}"


def _beside(path: Path) -> tuple[Path, Path]:
    """The file to write for a path, and an incomplete one beside it."""
    # Replace the target of a link, not the link, and never a device such as /dev/stdout.
    target = Path(os.path.realpath(path))
    if os.path.lexists(target) and not os.path.isfile(path):
        raise InputError(f"{path}: expected a file to write, found a folder or a device; choose another path")
    # Libraries choose the format by the suffix, so keep that of the given name, not of the link's target.
    return target, target.with_name(f"{_name()}{path.suffix[:64]}")


@contextmanager
def _temporary(path: Path, temporary: Path, *, folder: bool = False) -> Iterator[None]:
    """Create and lock an incomplete file or folder for ``path``, and remove it unless it is renamed in the block."""
    handle = -1
    try:
        with unfinished(temporary), writing(path):
            _sweep(temporary.parent)
            if folder:
                temporary.mkdir(parents=True)
            handle = os.open(temporary, os.O_RDONLY if folder else os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)
            _lock(handle)
            yield
    finally:
        delete(temporary)
        with suppress(OSError):
            os.close(handle)


def make_folder(path: Path) -> None:
    """Create a folder for results, if it does not exist.

    Raises:
        InputError: that is impossible.
    """
    with expecting(path, "a folder that can be written to"):
        path.mkdir(parents=True, exist_ok=True)


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
    with _temporary(path, _beside(path)[1]):
        pass


def remove(path: Path) -> None:
    """Remove a file if it exists.

    Raises:
        InputError: it is not a file, or the operating system refuses.
    """
    with writing(path):
        path.unlink(missing_ok=True)


def _lock(handle: int, *, wait: bool = False) -> bool:
    """Lock an open file or folder until it is closed; return false if another process has locked it."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
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
                delete(Path(path))
        finally:
            os.close(handle)


def listed(folder: Path) -> list[Path]:
    """The entries of a folder, sorted by their names.

    Raises:
        InputError: it cannot be listed.
    """
    with expecting(folder, "a folder that can be read"):
        return [folder / name for name in sorted(os.listdir(folder))]


def cannot_write(path: Path, reason: str) -> InputError:
    """The error of a file that cannot be written."""
    return InputError(f"{path}: cannot be written ({reason}); check the folder, its permissions and free space")


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Convert errors of the operating system in the block to an ``InputError`` about a path."""
    try:
        yield
    except OSError as error:
        raise cannot_write(path, error.strerror or type(error).__name__) from error
