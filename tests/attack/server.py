"""Runs commands and readers in forks of a process that has imported the package, with a time limit, or kills them.

Run as a program, this is the server: it reads a line of JSON with the processes to run at once, and answers with their
exit statuses. A fork takes a few hundredths of a second; a new process would take some seconds for its imports.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time
import traceback
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

# Time limit: hundreds of times the run time of most cases on an idle machine.
SECONDS = 60.0
# Address space beyond that of the server; readers of damaged files may request far more.
MEMORY = 6 * 2**30
HUNG = -1000


@dataclass(frozen=True)
class Process:
    """A process to run: arguments of ``mcdenoise``; or ``reader``, a name of ``table.READERS``, and a path.

    Its folder is the working directory, the home and the place of the cache; its output goes to a new file unless
    ``stdout`` names one. It starts after ``delay`` seconds, receives ``signal`` after ``kill_after``, counts as hung
    after ``seconds``, and may write no file larger than ``largest_file``, as on a full disk.
    """

    command: list[str]
    folder: str
    stdout: str = ""
    seconds: float = SECONDS
    delay: float = 0.0
    kill_after: float | None = None
    signal: int = signal.SIGKILL
    largest_file: int | None = None
    user: int | None = None


class Ended(NamedTuple):
    """The end of a process: its status, and what it printed."""

    status: int
    out: str
    err: str
    seconds: float


class Server:
    """The server; it runs until the end of the ``with`` block."""

    def __init__(self) -> None:
        # OpenMP threads do not survive a fork, and a forked process that waits for them hangs.
        environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
        command, pipe = [sys.executable, __file__], subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment)

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()

    def run(self, *processes: Process) -> list[Ended]:
        """Start all processes at once, and wait for them."""
        places = [f"{each.folder}/.output{i}" for i, each in enumerate(processes)]
        tasks = [asdict(each) | {"place": place} for each, place in zip(processes, places, strict=True)]
        self._process.stdin.write(json.dumps(tasks) + "\n")
        self._process.stdin.flush()
        answers = json.loads(self._process.stdout.readline())
        return [Ended(status, *taken(place), seconds) for (status, seconds), place in zip(answers, places, strict=True)]


def taken(place: str) -> tuple[str, str]:
    """Read and remove the files with a process's stdout and stderr."""
    texts = []
    for stream in ("out", "err"):
        path = Path(f"{place}.{stream}")
        # A process that was killed early has no file. Otherwise decode the output as for a terminal.
        texts.append(path.read_bytes().decode(errors="backslashreplace") if path.exists() else "")
        path.unlink(missing_ok=True)
    return texts[0], texts[1]


def serve() -> None:
    import table

    table.warm_up()
    room = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize() + MEMORY
    for line in sys.stdin:
        tasks = json.loads(line)
        started = time.monotonic()
        waiting = {fork(task, room): i for i, task in enumerate(tasks)}
        answers: list[tuple[int, float]] = [(0, 0.0)] * len(tasks)
        told: set[int] = set()
        while waiting:
            now = time.monotonic() - started
            for child, i in list(waiting.items()):
                done, status = os.waitpid(child, os.WNOHANG)
                if done:
                    answers[i] = (HUNG if child in told else os.waitstatus_to_exitcode(status)), now
                    del waiting[child]
                    # Kill the processes that it has started.
                    signal_all(child, signal.SIGKILL)
                elif now > tasks[i]["seconds"]:
                    told.add(child)
                    signal_all(child, signal.SIGKILL)
                elif tasks[i]["kill_after"] is not None and now > tasks[i]["kill_after"]:
                    tasks[i]["kill_after"] = None
                    signal_all(child, tasks[i]["signal"])
            time.sleep(0.001)
        print(json.dumps(answers), flush=True)
    # Skip the shutdown of libraries, which print messages.
    os._exit(0)


def signal_all(group: int, number: int) -> None:
    try:
        os.killpg(group, number)
    except ProcessLookupError:
        # The process has ended, or has not set its process group yet.
        try:
            os.kill(group, number)
        except ProcessLookupError:
            return


def fork(task: dict, room: int) -> int:
    child = os.fork()
    if child:
        return child
    status = 1
    try:
        os.setpgid(0, 0)
        out = task["stdout"] or f"{task['place']}.out"
        if task["stdout"]:
            Path(f"{task['place']}.out").touch()
        for stream, path in ((1, out), (2, f"{task['place']}.err")):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), stream)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.chdir(task["folder"])
        os.environ |= {"HOME": task["folder"], "XDG_CACHE_HOME": f"{task['folder']}/.cache"}
        resource.setrlimit(resource.RLIMIT_AS, (room, room))
        if task["largest_file"] is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (task["largest_file"],) * 2)
        if task["user"] is not None:
            os.setgid(task["user"])
            os.setuid(task["user"])
        time.sleep(task["delay"])
        status = run(task["command"])
    except BaseException:
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            try:
                stream.flush()
            except OSError:
                status = status or 1
        os._exit(status)


def run(command: list[str]) -> int:
    import table

    from mcdenoise import engines
    from mcdenoise.cli import main

    # A spawned worker imports everything again, for seconds; this process has no threads, so it can be forked.
    engines._pool = lambda: ProcessPoolExecutor(1, get_context("fork"), initializer=engines.prepare_worker)
    try:
        if command[0] == "reader":
            return table.read(command[1], Path(command[2]))
        main(command)
    except SystemExit as stop:
        # Exit like Python itself, without waiting for threads of libraries.
        return int(stop.code or 0)
    return 0


if __name__ == "__main__":
    serve()
