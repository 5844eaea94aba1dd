"""Ctrl+C and its like: one line, and the exit status that shells expect, whatever the process is doing."""

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

_WORDS = {"SIGINT": "interrupted", "SIGTERM": "terminated", "SIGHUP": "hung up"}
_NO_WARNING = "ignore:resource_tracker:UserWarning"
# Seconds in which the process may end by itself.
_GRACE = 1.25
# Files and folders that are being written, and are to go where that does not come to its end.
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
        resource_tracker.ensure_running()
    finally:
        sys.warnoptions.remove(_NO_WARNING)


@contextmanager
def unfinished(path: Path) -> Iterator[None]:
    """Within this, a file or folder is removed by who ends this process at once."""
    _unfinished.add(path)
    try:
        yield
    finally:
        _unfinished.discard(path)


def remove_unfinished() -> None:
    """Remove what is being written, as the last thing that this process does."""
    for path in list(_unfinished):
        with suppress(OSError):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink()


@contextmanager
def deaf_children() -> Iterator[None]:
    """Processes that are started within this do not hear Ctrl+C, from their first moment on.

    A terminal sends it to all processes of a command. The first one tells the others what to do; what they would print,
    while they import modules, is of no use. A signal that this process gets meanwhile interrupts it at the end of the
    block: a process that is half started would print why it cannot start.
    """
    masks = hasattr(signal, "pthread_sigmask")
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if masks else set()
    _starts.active, _starts.interrupted = True, False
    try:
        yield
    finally:
        _starts.active = False
        if masks:
            # A signal that came meanwhile is delivered now.
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if _starts.interrupted:
            raise KeyboardInterrupt


def prepare_worker() -> None:
    """In a worker process, first of all: SIGINT is for the driver, SIGTERM and SIGHUP end it, as does the driver's end.

    Before it ends it removes the files that it is writing. What it was told to ignore it ignores.
    """
    # Not every system can start a process with signals blocked.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for number in (getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end_worker)
    threading.Thread(target=_end_with_driver, daemon=True).start()


def _end_worker(number: int, frame: FrameType | None) -> None:
    remove_unfinished()
    os._exit(128 + number)


def _end_with_driver() -> None:
    # Imported here, as few processes need it. A worker whose driver was killed would wait for its next task for ever.
    import multiprocessing

    driver = multiprocessing.parent_process()
    if driver is not None:
        driver.join()
        remove_unfinished()
        os._exit(1)


class Interruption:
    """What a command does at SIGINT, SIGTERM and SIGHUP: one line on stderr, and status 128 and the signal's number.

    The main thread gets a ``KeyboardInterrupt``, so that all ``with`` and ``finally`` do their work. But what is not
    Python's, or is called by what is not, may swallow it, turn it into another exception, print it, or not return for
    minutes. So nothing else is printed from then on; whatever becomes of the exception the status is that of the
    signal; and a thread ends the process, after removing what is unfinished, where that takes longer than a moment.

    Args:
        name: of the command, for the line.

    Attributes:
        number: of the signal that has come; 0 if none has.
        listening: whether a ``KeyboardInterrupt`` would be caught. Where not, the process ends at once.
    """

    def __init__(self, name: str) -> None:
        self.number = 0
        self.listening = False
        self._line = f"mcdenoise{f' {name}' if name else ''}: {{}}; finished files are kept\n"
        self._said = threading.Lock()
        self._before: dict[int, signal._HANDLER] = {}
        self._pipe: tuple[int, int] | None = None

    def start(self) -> None:
        """Begin to obey signals; those that the process was told to ignore stay ignored, as by ``nohup``."""
        # Only there can it be done.
        if threading.current_thread() is not threading.main_thread():
            return
        self._pipe = reading, writing = os.pipe()
        os.set_blocking(writing, False)
        threading.Thread(target=self._watch, args=(reading,), daemon=True).start()
        signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
        for number in [getattr(signal, name) for name in _WORDS if hasattr(signal, name)]:
            if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
                self._before[number] = signal.signal(number, self._heard)
        # The last thing before the interpreter is taken apart: then all is done, and nobody is there to obey.
        atexit.register(self._ignore)
        if hasattr(os, "register_at_fork"):
            os.register_at_fork(after_in_child=self.stop)

    def stop(self) -> None:
        """Leave signals to what obeyed them before."""
        if self._pipe is None:
            return
        signal.set_wakeup_fd(-1)
        for number, handler in self._before.items():
            signal.signal(number, handler)
        atexit.unregister(self._ignore)
        # Its end ends the thread.
        os.close(self._pipe[1])
        self._pipe = None

    def status(self, otherwise: int) -> int:
        """The exit status: of the signal, if there was one."""
        return 128 + self.number if self.number else otherwise

    def _heard(self, number: int, frame: FrameType | None) -> None:
        again, self.number = bool(self.number), number
        self._say(number)
        # What is imported has nothing to tidy up, and is the least prepared for exceptions.
        if again or not self.listening or _is_importing(frame):
            self._end(number)
        if _starts.active:
            _starts.interrupted = True
            return
        raise KeyboardInterrupt

    def _ignore(self) -> None:
        if self._pipe is not None:
            for number in self._before:
                signal.signal(number, signal.SIG_IGN)

    def _watch(self, reading: int) -> None:
        """In a thread of its own: what holds up the main thread does not hold up this one."""
        while heard := os.read(reading, 1):
            if heard[0] in self._before:
                time.sleep(_GRACE)
                self._say(heard[0])
                self._end(heard[0])
        os.close(reading)

    def _say(self, number: int) -> None:
        """Say it, once, and let nobody else say anything any more."""
        # A handler may interrupt itself.
        if not self._said.acquire(blocking=False):
            return
        # The terminal may be gone.
        with suppress(OSError):
            # A progress bar hides it.
            cursor = "\x1b[?25h\n" if os.isatty(2) else ""
            os.write(2, f"{cursor}{self._line.format(_WORDS[signal.Signals(number).name])}".encode())
        with suppress(OSError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, 2)
            os.close(nowhere)

    def _end(self, number: int) -> None:
        remove_unfinished()
        os._exit(128 + number)


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False
