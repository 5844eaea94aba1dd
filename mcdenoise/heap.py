"""Memory that is freed and wanted again with every frame."""

from __future__ import annotations

import ctypes
import platform

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD, _MMAP_MAX = -1, -2, -3, -4  # of glibc's malloc.h


def keep_heap() -> None:
    """Let this process keep the memory that it frees, to have it again without the system's help.

    A frame's large tensors come and go. By default glibc gives each back to the system, which hands out pages of zeros
    for the next one: on a CPU a fifth of a fast network's time. It is a setting of the whole process and so a decision
    of whoever owns it: commands that run networks make it, the library does not. Does nothing where there is no glibc.
    """
    _set({_MMAP_MAX: 0, _TRIM_THRESHOLD: 2**31 - 1, _TOP_PAD: 64 << 20})


def return_heap() -> None:
    """Let this process give large pieces of memory back when they are freed, to hold as little as it can.

    What is kept lies between what is in use, and cannot always be had again for something larger: a network then takes
    up to 1.4 times the memory.
    """
    # What is smaller than the threshold may stay, 16 MiB of it.
    _set({_MMAP_MAX: 65536, _MMAP_THRESHOLD: 4 << 20, _TRIM_THRESHOLD: 16 << 20, _TOP_PAD: 4 << 20})


def _set(options: dict[int, int]) -> None:
    if platform.libc_ver()[0] == "glibc":
        libc = ctypes.CDLL(None)
        for option, value in options.items():
            libc.mallopt(option, value)
