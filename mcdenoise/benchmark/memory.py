"""How much memory a method adds at its peak."""

from __future__ import annotations

import functools
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path

import torch

from mcdenoise.benchmark.machine import fix_threads
from mcdenoise.benchmark.methods import make_method
from mcdenoise.frame import Frame
from mcdenoise.interruption import deaf_children
from mcdenoise.results import Method

Frames = Callable[[], list[Frame]]
Make = Callable[[], Callable[[Frame], object]]

_STATUS, _FORGET_PEAK = Path("/proc/self/status"), Path("/proc/self/clear_refs")
# What methods import, at the latest when they are called: torch the second of these, with the first operator of ours.
_PRELOADED = ["__main__", "torch._dynamo", "numba", "pyoidn", "mcdenoise.benchmark.run"]
_SECONDS = 300.0


class Peaks:
    """Peak memory of methods at sizes of images, each measured once.

    Args:
        threads: of the methods.
        device: ``"cpu"`` or ``"cuda"``.
    """

    def __init__(self, threads: int, device: str) -> None:
        self._threads, self._device = threads, device
        self._known: dict[tuple[str, tuple[int, int]], float | None] = {}

    def of(self, method: Method, size: tuple[int, int], frames: Frames) -> float | None:
        """See :func:`peak_memory`; ``frames`` are of the size, and read only if it was not asked for before."""
        key = method.name, size
        if key not in self._known:
            make = functools.partial(make_method, method, threads=self._threads, device=self._device)
            self._known[key] = peak_memory(make, frames, threads=self._threads, device=self._device)
        return self._known[key]


def peak_memory(make: Make, frames: Frames, *, threads: int, device: str, seconds: float = _SECONDS) -> float | None:
    """Memory that making a method and denoising some frames adds at its peak: weights, history and all.

    On a CPU it is the peak of the resident set in a fresh process, less the resident set before: the frames are there
    already, and so are the modules of torch, numba and Open Image Denoise. Pages that an allocator has freed and kept
    count, as they do for everyone else on the machine.
    On a GPU it is what torch had allocated there at the peak, less what it had before; a library that allocates by
    itself is not seen.

    Args:
        make: makes the method, whose first calls may still warm up; another process must be able to call it: a function
            of a module, or :func:`functools.partial` of one.
        frames: reads or makes the frames, on the CPU; another process must be able to call it.
        threads: of the method.
        device: ``"cpu"`` or ``"cuda"``.
        seconds: for which another process may take; then it is ended.

    Returns:
        Mebibytes, or ``None`` where it cannot be measured: the system does not tell, or the method cannot be given to
        another process, or fails there, or does not come to an end.
    """
    if device == "cuda":
        return _peak_on_gpu(make, frames)
    if not _FORGET_PEAK.exists():
        return None
    # Started from a server that has imported everything, and nothing has run in: a fresh process in a moment.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOADED)
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send_peak, args=(sender, make, frames, threads), daemon=True)
    try:
        with deaf_children():
            process.start()
    except Exception:  # whatever an object refuses with that only this process can have
        return None
    sender.close()
    try:
        return float(receiver.recv()) if receiver.poll(seconds) else None
    except EOFError:
        return None
    finally:
        process.kill()
        process.join()


def _send_peak(sender: Connection, make: Make, frames: Frames, threads: int) -> None:
    # Where it could not be made deaf from its first moment on.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(Exception):  # whatever the method fails with: where it matters, it is found out by denoising
        sender.send(_peak_of_this_process(make, frames, threads))


def _end_with_parent() -> None:
    # A method that hangs would outlive a benchmark that was killed.
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _peak_of_this_process(make: Make, frames: Frames, threads: int) -> float:
    fix_threads(threads)
    shown = frames()
    _FORGET_PEAK.write_text("5")
    before = _status("VmRSS")
    runner = make()
    for frame in shown:
        runner(frame)
    return (_status("VmHWM") - before) / 1024


def _status(name: str) -> int:
    """Kibibytes."""
    lines = _STATUS.read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{name}:"))


def _peak_on_gpu(make: Make, frames: Frames) -> float | None:
    shown = [frame.to("cuda") for frame in frames()]
    before = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    try:
        runner = make()
        for frame in shown:
            runner(frame)
    except Exception:  # as above
        return None
    added = torch.cuda.max_memory_allocated() - before
    # Nothing at all: it runs elsewhere.
    return added / 2**20 if added else None
