"""Handling of Ctrl+C and other signals: one line of output and the conventional exit status, in any situation."""

from __future__ import annotations

import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import NoReturn

_WORDS = {"SIGINT": "interrupted", "SIGTERM": "terminated", "SIGHUP": "hung up"}
# The environment variable for the option -P of Python.
_SAFE_PATH = "PYTHONSAFEPATH"
_NO_WARNING = "ignore:resource_tracker:UserWarning"
# Longest time in seconds for what has begun.
_GRACE = 1.25
# Incomplete files and folders, to be removed if the process ends early.
_unfinished: set[Path] = set()
# Held while a process is started: one that loses its parent half-way prints why it cannot start.
_starting = threading.Lock()
# Set once this process is ending.
_ending = threading.Event()


def start_resource_tracker() -> None:
    """Start the process that removes the semaphores of pools whose process has ended, without a warning of each."""
    from multiprocessing import resource_tracker

    # It is started with the options of this interpreter.
    sys.warnoptions.append(_NO_WARNING)
    try:
        with safe_path():
            resource_tracker.ensure_running()
    finally:
        sys.warnoptions.remove(_NO_WARNING)


@contextmanager
def safe_path() -> Iterator[None]:
    """Start Python processes inside this block that import nothing from the working folder, which may be anyone's."""
    before = os.environ.get(_SAFE_PATH)
    os.environ[_SAFE_PATH] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[_SAFE_PATH]
        else:
            os.environ[_SAFE_PATH] = before


@contextmanager
def unfinished(path: Path) -> Iterator[None]:
    """Remove a file or folder if the process is ended by a signal inside this block."""
    _unfinished.add(path)
    try:
        yield
    finally:
        _unfinished.discard(path)


def remove_unfinished() -> None:
    """Remove all incomplete files, as the last action of the process."""
    for path in list(_unfinished):
        delete(path)


def delete(path: Path) -> None:
    """Remove a file, or a folder with its contents, if that is possible."""
    with suppress(OSError):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink()


@contextmanager
def deaf_children() -> Iterator[None]:
    """Start child processes inside this block that ignore Ctrl+C from the beginning, with a :func:`safe_path`.

    A terminal sends Ctrl+C to all processes of a command. The main process tells its children what to do; tracebacks
    from children that are still importing modules would not help.
    """
    masks = hasattr(signal, "pthread_sigmask")
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if masks else set()
    try:
        with _starting, safe_path():
            yield
    finally:
        if masks:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def prepare_worker() -> None:
    """Set up the signals of a worker process: it ignores SIGINT, and ends at SIGTERM, SIGHUP or the end of its driver.

    Before it ends it removes the files that it is writing. It must be called first. Signals that were ignored before
    stay ignored.
    """
    # Not every system can start a process with signals blocked.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for number in (getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda number, frame: _end(128 + number))
    threading.Thread(target=_end_with_driver, daemon=True).start()


def _end(status: int) -> NoReturn:
    remove_unfinished()
    os._exit(status)


def _end_with_driver() -> None:
    # Imported here, as few processes need it. A worker whose driver was killed would wait for its next task for ever.
    import multiprocessing

    driver = multiprocessing.parent_process()
    if driver is not None:
        driver.join()
        _end(1)


def heed_signals(name: str) -> None:
    """End this process at SIGINT, SIGTERM or SIGHUP: with one line on stderr, and 128 plus the signal's number.

    A thread does this at once, whatever the main thread does: native code may not return for minutes, and may swallow
    an exception. So no ``with`` or ``finally`` block runs; what must not stay behind is :func:`unfinished`. Signals
    that the process was told to ignore, as by ``nohup``, stay ignored. Call it in the main thread.

    Args:
        name: name of the command, printed in the line.
    """
    numbers = [getattr(signal, each) for each in _WORDS if hasattr(signal, each)]
    defaults = (signal.SIG_DFL, signal.default_int_handler)
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    before = {number: signal.signal(number, _wait) for number in numbers if signal.getsignal(number) in defaults}
    threading.Thread(target=_watch, args=(name, reading, set(before)), daemon=True).start()

    def restore() -> None:
        signal.set_wakeup_fd(-1)
        for number, handler in before.items():
            signal.signal(number, handler)

    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=restore)


def _wait(number: int, frame: FrameType | None) -> None:
    """Keep the main thread from doing anything more, except to start a process that it has begun to start."""
    while _ending.is_set() or not _starting.locked():
        time.sleep(1)


def _watch(name: str, reading: int, numbers: set[int]) -> NoReturn:
    """Wait for one of these signals in a separate thread, which works even if the main thread is blocked."""
    while (number := os.read(reading, 1)[0]) not in numbers:
        pass
    _say(f"mcdenoise{f' {name}' if name else ''}: {_WORDS[signal.Signals(number).name]}; finished files are kept\n")
    # The main thread may be writing to the same stream.
    flushing = threading.Thread(target=_flush, daemon=True)
    flushing.start()
    flushing.join(_GRACE)
    _starting.acquire(timeout=_GRACE)
    _ending.set()
    _end(128 + number)


def _flush() -> None:
    # Its reader may be gone, or the disk full.
    with suppress(OSError, ValueError, AttributeError):
        sys.stdout.flush()


def _say(line: str) -> None:
    """Print a line, and suppress all further output."""
    # The terminal may have been closed.
    with suppress(OSError):
        # Restore the cursor, which a progress bar hides.
        cursor = "\x1b[?25h\n" if os.isatty(2) else ""
        os.write(2, f"{cursor}{line}".encode())
    with suppress(OSError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 2)
        os.close(nowhere)
