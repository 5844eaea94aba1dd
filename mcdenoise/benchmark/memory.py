"""Measurement of the peak memory of a method, and of a command."""

from __future__ import annotations

import functools
import multiprocessing
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import torch

from mcdenoise.benchmark.machine import fix_threads
from mcdenoise.benchmark.methods import make_method
from mcdenoise.engines import end_pools
from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.interruption import deaf_children, prepare_worker
from mcdenoise.results import Method

Frames = Callable[[], list[Frame]]
Make = Callable[[], Callable[[Frame], object]]

_STATUS, _FORGET_PEAK = Path("/proc/self/status"), Path("/proc/self/clear_refs")
# Modules that methods import, at the latest when they run; the first custom operator imports torch._dynamo.
_PRELOADED = ["__main__", "torch._dynamo", "numba", "pyoidn", "mcdenoise.benchmark.run"]
_SECONDS = 300.0
# A process that is as small as Python is: the peak of a process is at least that of the one that started it.
_LAUNCHER = """
import os, sys
command = sys.argv[1:]
_, status, usage = os.wait4(os.posix_spawn(command[0], command, os.environ), 0)
if not status:
    print(usage.ru_maxrss)
sys.exit(os.waitstatus_to_exitcode(status))
"""


def output_and_peak(*arguments: object) -> tuple[str, float]:
    """Return what ``mcdenoise`` prints with these arguments, and the peak of its resident set size in GB, on Linux.

    Raises:
        InputError: the command fails; the message ends with the last line that it printed.
    """
    command = [sys.executable, "-P", "-c", _LAUNCHER, sys.executable, "-P", "-m", "mcdenoise", *map(str, arguments)]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    if done.returncode:
        last = done.stdout.strip().rpartition("\n")[2]
        raise InputError(f"mcdenoise {arguments[0]}: expected to succeed, found: {last}")
    printed, _, kibibytes = done.stdout.rstrip("\n").rpartition("\n")
    return printed, int(kibibytes) * 1024 / 1e9


class Peaks:
    """Peak memory by method and image size, each measured once.

    Args:
        threads: number of threads.
        device: ``"cpu"`` or ``"cuda"``.
    """

    def __init__(self, threads: int, device: str) -> None:
        self._threads, self._device = threads, device
        self._known: dict[tuple[str, tuple[int, int]], float | None] = {}

    def of(self, method: Method, size: tuple[int, int], frames: Frames) -> float | None:
        """See :func:`peak_memory`; ``frames`` returns frames of this size, and is called on the first request only."""
        key = method.name, size
        if key not in self._known:
            make = functools.partial(make_method, method, threads=self._threads, device=self._device)
            self._known[key] = peak_memory(make, frames, threads=self._threads, device=self._device)
        return self._known[key]


def peak_memory(make: Make, frames: Frames, *, threads: int, device: str, seconds: float = _SECONDS) -> float | None:
    """Peak memory of constructing a method and denoising some frames: weights, history and temporary buffers.

    On a CPU it is the peak resident set size of a fresh process minus its resident set size before, when the frames and
    the modules of torch, numba and Open Image Denoise are already loaded. Memory that an allocator has freed but not
    returned to the system counts.
    On a GPU it is the peak of torch's allocated memory minus the memory allocated before; memory that other libraries
    allocate is not included.

    Args:
        make: constructs the method, whose first calls may still warm up; it must be picklable, such as a function of a
            module, or :func:`functools.partial` of one.
        frames: reads or makes the frames, on the CPU; it must be picklable.
        threads: number of threads of the method.
        device: ``"cpu"`` or ``"cuda"``.
        seconds: time limit for the other process.

    Returns:
        Mebibytes, or ``None`` if it cannot be measured: the system does not report it, or the method cannot be sent to
        another process, fails there, or exceeds the time limit.
    """
    if device == "cuda":
        return _peak_on_gpu(make, frames)
    if not _FORGET_PEAK.exists():
        return None
    # The fork server has imported all modules and run nothing, so that a fresh process starts quickly.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOADED)
    pool = ProcessPoolExecutor(1, context, initializer=prepare_worker)
    try:
        with deaf_children():
            call = pool.submit(_peak_of_this_process, make, frames, threads)
        return call.result(seconds)
    except Exception:  # it cannot be pickled, or hangs; the benchmark itself reports an exception of the method
        return None
    finally:
        end_pools([pool], grace=0)


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
    """A size in kibibytes from the status of this process."""
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
    except Exception:  # the benchmark itself reports it
        return None
    added = torch.cuda.max_memory_allocated() - before
    # A method that allocated nothing runs on another device.
    return added / 2**20 if added else None
