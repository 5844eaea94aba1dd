"""Freed memory that stays with the process."""

import platform
import subprocess
import sys

import pytest

CODE = """
import resource, sys, torch
from mcdenoise.heap import keep_heap
if sys.argv[1] == "keep":
    keep_heap()
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    torch.ones(32 << 20, dtype=torch.uint8)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
# A place that was freed is too small by some bytes until its neighbours are free too: each is had anew a few times.
for _ in range(32):
    faults()
print(min(faults() for _ in range(4)) if sys.argv[1] == "give back" else sum(faults() for _ in range(4)))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="a setting of glibc's malloc")
def test_memory_that_is_freed_is_had_again_without_page_faults() -> None:
    faults = {
        choice: int(subprocess.run([sys.executable, "-c", CODE, choice], capture_output=True, check=True).stdout)
        for choice in ("keep", "give back")
    }
    # 32 MiB are 8192 pages of 4 KiB, or 16 of 2 MiB.
    assert faults["keep"] < 4
    assert faults["give back"] >= 16
