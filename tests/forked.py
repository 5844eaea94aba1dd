"""Runs scripts in processes that have imported what takes seconds: each is a fork of a server that does nothing else.

As a program this is the server: it reads a script, its arguments and where its output goes from each line of stdin, and
answers with the exit status. A script finds its folder first in ``sys.path`` and itself as ``__main__``, as if it had
been started by its name.
"""

from __future__ import annotations

import atexit
import importlib
import json
import os
import runpy
import signal
import subprocess
import sys
from pathlib import Path

# A module that starts threads or looks at the machine when it is imported, such as Mitsuba, is not among them: the
# script imports it.
MODULES = (
    "mcdenoise",
    "mcdenoise.benchmark",
    "mcdenoise.cli",
    "mcdenoise.data",
    "mcdenoise.evaluate",
    "mcdenoise.methods",
    "mcdenoise.metrics",
    "mcdenoise.models",
    "mcdenoise.ops",
    "kornia",
)


class Server:
    """The server, started when it is first asked for something; it ends with this process."""

    def __init__(self) -> None:
        self.process: subprocess.Popen[str] | None = None

    def run(self, script: Path, arguments: list[str], folder: Path, seconds: int) -> subprocess.CompletedProcess[str]:
        """A script's exit status, and what it printed.

        Args:
            script: the file.
            arguments: of its command line.
            folder: where what it prints is kept meanwhile.
            seconds: after so many it is killed.
        """
        if self.process is None:
            command = [sys.executable, __file__]
            self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            atexit.register(self.close)
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        out, err = folder / "stdout", folder / "stderr"
        task = [str(script), arguments, str(out), str(err), seconds]
        self.process.stdin.write(json.dumps(task) + "\n")
        self.process.stdin.flush()
        status = int(self.process.stdout.readline())
        return subprocess.CompletedProcess([str(script), *arguments], status, out.read_text(), err.read_text())

    def close(self) -> None:
        """End the server, which stops at the end of its stdin."""
        if self.process is not None:
            self.process.communicate()
            self.process = None


def serve() -> None:
    for name in MODULES:
        importlib.import_module(name)
    for line in sys.stdin:
        script, arguments, out, err, seconds = json.loads(line)
        child = os.fork()
        if child == 0:
            for stream, path in ((1, out), (2, err)):
                os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), stream)
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            signal.alarm(seconds)
            sys.argv, sys.path[0] = [script, *arguments], str(Path(script).parent)
            runpy.run_path(script, run_name="__main__")
            return
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


if __name__ == "__main__":
    serve()
