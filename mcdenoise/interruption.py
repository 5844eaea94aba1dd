"""Handling of Ctrl+C and other signals: one line of output and the conventional exit status, in any situation."""

from __future__ import annotations

import atexit
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
# Time in seconds for an orderly shutdown.
_GRACE = 1.25
# Incomplete files and folders, to be removed if the process ends early.
_unfinished: set[Path] = set()


class _Starts:
    """Whether a process is being started, and whether a signal came meanwhile; another thread may get it."""

    active = False
    interrupted = False


_starts = _Starts()


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
    from children that are still importing modules would not help. A signal that this process receives inside the block
    interrupts it at the end of the block, because a half-started process would print why it cannot start.
    """
    masks = hasattr(signal, "pthread_sigmask")
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if masks else set()
    _starts.active, _starts.interrupted = True, False
    try:
        with safe_path():
            yield
    finally:
        _starts.active = False
        if masks:
            # A signal that came meanwhile is delivered now.
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if _starts.interrupted:
            raise KeyboardInterrupt


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


class Interruption:
    """Handles SIGINT, SIGTERM and SIGHUP: prints one line to stderr, and exits with 128 plus the signal's number.

    The main thread gets a ``KeyboardInterrupt``, so that all ``with`` and ``finally`` blocks run. But native code, or
    Python code called by it, may swallow the exception, convert or print it, or not return for minutes. Therefore
    nothing else is printed afterwards; the exit status is that of the signal whatever happens to the exception; and if
    the shutdown takes too long, a thread removes incomplete files and ends the process.

    Args:
        name: name of the command, printed in the line.

    Attributes:
        number: number of the received signal; 0 if there was none.
        listening: whether a ``KeyboardInterrupt`` would be caught. If not, the process ends at once.
    """

    def __init__(self, name: str) -> None:
        self.number = 0
        self.listening = False
        self._line = f"mcdenoise{f' {name}' if name else ''}: {{}}; finished files are kept\n"
        self._said = threading.Lock()
        self._before: dict[int, signal._HANDLER] = {}
        self._pipe: tuple[int, int] | None = None

    def start(self) -> None:
        """Install the handlers; signals that the process was told to ignore, as by ``nohup``, stay ignored."""
        # Python allows this in the main thread only.
        if threading.current_thread() is not threading.main_thread():
            return
        self._pipe = reading, writing = os.pipe()
        os.set_blocking(writing, False)
        threading.Thread(target=self._watch, args=(reading,), daemon=True).start()
        signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
        for number in [getattr(signal, name) for name in _WORDS if hasattr(signal, name)]:
            if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
                self._before[number] = signal.signal(number, self._heard)
        # Runs last before the interpreter shuts down: all work is done then.
        atexit.register(self._ignore)
        if hasattr(os, "register_at_fork"):
            os.register_at_fork(after_in_child=self.stop)

    def stop(self) -> None:
        """Restore the previous handlers."""
        if self._pipe is None:
            return
        signal.set_wakeup_fd(-1)
        for number, handler in self._before.items():
            signal.signal(number, handler)
        atexit.unregister(self._ignore)
        # Closing the pipe ends the thread.
        os.close(self._pipe[1])
        self._pipe = None

    def _heard(self, number: int, frame: FrameType | None) -> None:
        again, self.number = bool(self.number), number
        self._say(number)
        # An import has nothing to clean up, and modules rarely handle exceptions while they are imported.
        if again or not self.listening or _is_importing(frame):
            _end(128 + number)
        if _starts.active:
            _starts.interrupted = True
            return
        raise KeyboardInterrupt

    def _ignore(self) -> None:
        if self._pipe is not None:
            for number in self._before:
                signal.signal(number, signal.SIG_IGN)

    def _watch(self, reading: int) -> None:
        """Wait for a signal in a separate thread, which works even if the main thread is blocked."""
        while heard := os.read(reading, 1):
            if heard[0] in self._before:
                time.sleep(_GRACE)
                self._say(heard[0])
                _end(128 + heard[0])
        os.close(reading)

    def _say(self, number: int) -> None:
        """Print the line once, and suppress all further output."""
        # A handler may interrupt itself.
        if not self._said.acquire(blocking=False):
            return
        # The terminal may have been closed.
        with suppress(OSError):
            # Restore the cursor, which a progress bar hides.
            cursor = "\x1b[?25h\n" if os.isatty(2) else ""
            os.write(2, f"{cursor}{self._line.format(_WORDS[signal.Signals(number).name])}".encode())
        with suppress(OSError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, 2)
            os.close(nowhere)


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False
