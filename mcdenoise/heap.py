"""Memory that is freed and wanted again with every frame."""

from __future__ import annotations

import ctypes
import platform

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_MAX = -1, -2, -4  # of glibc's malloc.h


def keep_heap() -> None:
    """Let this process keep the memory that it frees, to have it again without the system's help.

    A frame's large tensors come and go. By default glibc gives each back to the system, which hands out pages of zeros
    for the next one: on a CPU a fifth of a fast network's time. It is a setting of the whole process and so a decision
    of whoever owns it: commands that run networks make it, the library does not. Does nothing where there is no glibc.
    """
    if platform.libc_ver()[0] != "glibc":
        return
    libc = ctypes.CDLL(None)
    libc.mallopt(_MMAP_MAX, 0)
    libc.mallopt(_TRIM_THRESHOLD, 2**31 - 1)
    libc.mallopt(_TOP_PAD, 64 << 20)
