"""The peak memory of a command."""

from __future__ import annotations

import subprocess
import sys

# The peak of a process is at least that of the one that started it, which in pytest may be large; this one is small.
_LAUNCHER = """
import os, sys
command = sys.argv[1:]
_, status, usage = os.wait4(os.posix_spawn(command[0], command, os.environ), 0)
if not status:
    print(usage.ru_maxrss)
sys.exit(os.waitstatus_to_exitcode(status))
"""


def output_and_peak(*arguments: object) -> tuple[str, float]:
    """Return what ``mcdenoise`` prints with these arguments, and the peak of its memory in GB; it must succeed."""
    command = [sys.executable, "-m", "mcdenoise", *map(str, arguments)]
    done = subprocess.run(
        [sys.executable, "-c", _LAUNCHER, *command], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert done.returncode == 0, done.stdout
    *printed, kibibytes = done.stdout.splitlines()
    return "\n".join(printed), int(kibibytes) * 1024 / 1e9
