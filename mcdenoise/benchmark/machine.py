"""The machine that a benchmark runs on: its description, device, threads and free memory."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import OpenImageIO as oiio
import torch

from mcdenoise.commit import source_commit
from mcdenoise.errors import InputError
from mcdenoise.results import Machine

_PACKAGES = ("torch", "kornia", "numpy", "openimageio", "pyoidn", "flip-evaluator")
_CGROUP = Path("/sys/fs/cgroup")


def check_device(device: str) -> None:
    """Check that torch can use a device.

    Raises:
        InputError: the device is unknown, or torch cannot use it.
    """
    if device not in ("cpu", "cuda"):
        raise InputError(f"--device: expected cpu or cuda, found '{device}'")
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError("--device: expected a GPU that torch can use, found none; use cpu")


def fix_threads(threads: int) -> None:
    """Set the number of threads of torch, and of reading and writing EXRs."""
    torch.set_num_threads(threads)
    oiio.attribute("threads", threads)
    oiio.attribute("exr_threads", threads)


def describe_machine(device: str) -> Machine:
    """Describe this machine, with torch's current number of threads."""
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
    """Bytes that can be allocated on the device now; ``None`` if the system does not report it."""
    if device == "cuda":
        return torch.cuda.mem_get_info()[0]
    sizes = [size for size in (_free_memory(), _free_in_container()) if size is not None]
    return min(sizes, default=None)


def _free_memory() -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:")), None)


def _free_in_container() -> int | None:
    """Bytes up to the memory limit of the container; ``None`` without a limit."""
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
