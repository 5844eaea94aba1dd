"""The machine that a benchmark runs on: its description, device, threads and free memory."""

from __future__ import annotations

import os
import platform
import re
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import OpenImageIO as oiio
import torch

from mcdenoise.commit import source_commit
from mcdenoise.errors import InputError
from mcdenoise.results import Machine

_PACKAGES = ("torch", "kornia", "numpy", "openimageio", "pyoidn", "flip-evaluator")


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
    names = re.findall(r"(?m)^model name\s*: *(.+)", _text("/proc/cpuinfo"))
    return Machine(
        processor=names[0] if names else platform.processor() or platform.machine(),
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
    sizes = [int(size) * 1024 for size in re.findall(r"(?m)^MemAvailable: +(\d+)", _text("/proc/meminfo"))]
    # A container without a limit says "max".
    if (limit := _text("/sys/fs/cgroup/memory.max").strip()).isdecimal():
        sizes.append(int(limit) - int(_text("/sys/fs/cgroup/memory.current")))
    return min(sizes, default=None)


def _text(path: str) -> str:
    """What a file of the system says; nothing where there is none."""
    try:
        return Path(path).read_text()
    except OSError:
        return ""


def _versions() -> dict[str, str]:
    versions = {"mcdenoise": f"{version('mcdenoise')}, commit {source_commit()}"}
    for name in _PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return versions
