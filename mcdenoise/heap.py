"""Settings of the C heap, for memory that is freed and allocated again with every frame."""

from __future__ import annotations

import ctypes
import platform

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD, _MMAP_MAX = -1, -2, -3, -4  # from glibc's malloc.h


def keep_heap() -> None:
    """Make this process keep freed memory for later allocations instead of returning it to the system.

    A frame's large tensors are allocated and freed again and again. By default glibc returns each of them to the
    system, which provides zeroed pages for the next one; this takes a fifth of a fast network's time on a CPU. The
    setting applies to the whole process, so commands that run networks call this function and the library does not. It
    has no effect without glibc.
    """
    _set({_MMAP_MAX: 0, _TRIM_THRESHOLD: 2**31 - 1, _TOP_PAD: 64 << 20})


def return_heap() -> None:
    """Make this process return large pieces of freed memory to the system, to use as little memory as possible.

    Kept memory is fragmented and cannot always be reused for larger tensors; a network then takes up to 1.4 times the
    memory.
    """
    # Up to 16 MiB of memory below the threshold may be kept.
    _set({_MMAP_MAX: 65536, _MMAP_THRESHOLD: 4 << 20, _TRIM_THRESHOLD: 16 << 20, _TOP_PAD: 4 << 20})


def _set(options: dict[int, int]) -> None:
    if platform.libc_ver()[0] == "glibc":
        libc = ctypes.CDLL(None)
        for option, value in options.items():
            libc.mallopt(option, value)
