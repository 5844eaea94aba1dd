"""Measuring the peak memory of methods."""

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
# Modules that methods import: torch imports the second one when the first custom operator is called.
_PRELOADED = ["__main__", "torch._dynamo", "numba", "pyoidn", "mcdenoise.benchmark.run"]
_SECONDS = 300.0


class Peaks:
    """Peak memory of methods by image size, each measured once.

    Args:
        threads: number of threads of the methods.
        device: ``"cpu"`` or ``"cuda"``.
    """

    def __init__(self, threads: int, device: str) -> None:
        self._threads, self._device = threads, device
        self._known: dict[tuple[str, tuple[int, int]], float | None] = {}

    def of(self, method: Method, size: tuple[int, int], frames: Frames) -> float | None:
        """See :func:`peak_memory`; ``frames`` have the given size, and are read only for a new combination."""
        key = method.name, size
        if key not in self._known:
            make = functools.partial(make_method, method, threads=self._threads, device=self._device)
            self._known[key] = peak_memory(make, frames, threads=self._threads, device=self._device)
        return self._known[key]


def peak_memory(make: Make, frames: Frames, *, threads: int, device: str, seconds: float = _SECONDS) -> float | None:
    """Peak memory that creating a method and denoising frames adds, including weights and history.

    On a CPU this is the peak of the resident set in a new process, minus the resident set before, which includes the
    frames and the modules of torch, numba and Open Image Denoise. Pages that an allocator has freed but kept count,
    because they are not available to other processes either. On a GPU it is the peak of torch's allocations minus those
    before; allocations of other libraries are not included.

    Args:
        make: creates the method, whose first calls may still warm up. It must be picklable: a function of a module, or
            a :func:`functools.partial` of one.
        frames: reads or makes the frames, on the CPU; it must be picklable.
        threads: number of threads of the method.
        device: ``"cpu"`` or ``"cuda"``.
        seconds: time limit of the process.

    Returns:
        Mebibytes, or ``None`` if the memory cannot be measured: the system does not tell, or the method is not
        picklable, fails in the process, or exceeds the time limit.
    """
    if device == "cuda":
        return _peak_on_gpu(make, frames)
    if not _FORGET_PEAK.exists():
        return None
    # A fork server that has imported all modules, but run nothing, starts a fresh process quickly.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOADED)
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send_peak, args=(sender, make, frames, threads), daemon=True)
    try:
        with deaf_children():
            process.start()
    except Exception:  # an object that is not picklable may raise anything
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
    # Ignore Ctrl+C, in case the process was not started ignoring it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(Exception):  # denoising reports the failure
        sender.send(_peak_of_this_process(make, frames, threads))


def _end_with_parent() -> None:
    # A method that hangs must not outlive a killed benchmark.
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
    except Exception:  # a method may raise anything
        return None
    added = torch.cuda.max_memory_allocated() - before
    # A peak of zero means that the method runs elsewhere.
    return added / 2**20 if added else None
