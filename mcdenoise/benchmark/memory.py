"""How much memory a method adds at its peak."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import torch

from mcdenoise.benchmark.machine import fix_threads
from mcdenoise.benchmark.methods import Runner
from mcdenoise.buffers import Frame

Frames = Callable[[], list[Frame]]

_STATUS, _FORGET_PEAK = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def peak_memory(make: Callable[[], Runner], frames: Frames, *, threads: int, device: str) -> float | None:
    """Memory that making a method and denoising some frames adds at its peak: weights, history and all.

    On a CPU it is the peak of the resident set in a fresh process, less the resident set before: torch and the frames
    are there already. Pages that an allocator has freed and kept count, as they do for everyone else on the machine.
    On a GPU it is what torch had allocated there at the peak, less what it had before; a library that allocates by
    itself is not seen.

    Args:
        make: see :class:`mcdenoise.benchmark.methods.Candidate`.
        frames: reads or makes the frames, on the CPU; another process must be able to call it.
        threads: of the method.
        device: ``"cpu"`` or ``"cuda"``.

    Returns:
        Mebibytes, or ``None`` where it cannot be measured: the system does not tell, or the method cannot be given to
        another process, or fails there.
    """
    if device == "cuda":
        return _peak_on_gpu(make, frames)
    if not _FORGET_PEAK.exists():
        return None
    # Started from a server that has imported everything, and nothing has run in: a fresh process in a moment.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["__main__", "mcdenoise.benchmark.run"])
    try:
        with ProcessPoolExecutor(1, mp_context=context) as processes:
            return processes.submit(_peak_of_this_process, make, frames, threads).result()
    except Exception:  # whatever the method fails with: where it matters, it is found out by denoising
        return None


def _peak_of_this_process(make: Callable[[], Runner], frames: Frames, threads: int) -> float:
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


def _peak_on_gpu(make: Callable[[], Runner], frames: Frames) -> float | None:
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
