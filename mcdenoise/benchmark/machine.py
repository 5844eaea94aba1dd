"""The machine of a benchmark: its description, number of threads, busy cores, and memory."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import OpenImageIO as oiio
import torch

from mcdenoise.commit import source_commit
from mcdenoise.errors import InputError
from mcdenoise.interruption import deaf_children
from mcdenoise.results import Machine

_PACKAGES = ("torch", "kornia", "numpy", "openimageio", "pyoidn", "flip-evaluator")
_CGROUP = Path("/sys/fs/cgroup")


def check_device(device: str) -> None:
    """Check that torch can use a device.

    Raises:
        InputError: it cannot.
    """
    if device not in ("cpu", "cuda"):
        raise InputError(f"--device: expected cpu or cuda, found '{device}'")
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError("--device: expected a GPU that torch can use, found none; take cpu")


def fix_threads(threads: int) -> None:
    """Set the number of threads of torch, and of reading and writing EXRs."""
    torch.set_num_threads(threads)
    oiio.attribute("threads", threads)
    oiio.attribute("exr_threads", threads)


@contextmanager
def busy_cores(count: int) -> Iterator[None]:
    """Keep cores busy inside this block, to simulate a renderer: one process per core runs an endless loop."""
    # Each process ends itself when this process is gone.
    code = f"import os\nwhile os.getppid() == {os.getpid()}:\n    sum(range(100_000))"
    started: list[subprocess.Popen[bytes]] = []
    try:
        for _ in range(count):
            with deaf_children():
                started.append(subprocess.Popen([sys.executable, "-I", "-S", "-c", code]))
        yield
    finally:
        for process in started:
            process.kill()
            process.wait()


def describe_machine(device: str) -> Machine:
    """Describe the machine, with torch's current number of threads."""
    return Machine(
        processor=_processor(),
        cores=len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
        memory=round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        device=torch.cuda.get_device_name() if device == "cuda" else "cpu",
        threads=torch.get_num_threads(),
        system=platform.platform(),
        packages=_versions(),
    )


def available_memory(device: str) -> int | None:
    """Bytes that can be allocated on the device; ``None`` if the system does not tell."""
    if device == "cuda":
        return torch.cuda.mem_get_info()[0]
    sizes = [size for size in (_free_memory(), _left_of_limit()) if size is not None]
    return min(sizes, default=None)


def _free_memory() -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")), None)


def _left_of_limit() -> int | None:
    """Remaining memory within a container's limit."""
    try:
        limit, used = ((_CGROUP / name).read_text().strip() for name in ("memory.max", "memory.current"))
    except OSError:
        return None
    return None if limit == "max" else int(limit) - int(used)


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or platform.machine())


def _versions() -> dict[str, str]:
    versions = {"mcdenoise": f"{version('mcdenoise')}, commit {source_commit()}"}
    for name in _PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return versions
