"""Runs commands and readers in forks of a process that has imported the package, with a time limit, or kills them.

As a program this is the server: it reads a line of JSON that says what runs side by side, and answers with the exit
statuses. A fork takes a few hundredths of a second, where a new process would take some seconds for its imports.
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
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import NamedTuple

# Hundreds of times what most cases take on an idle machine.
SECONDS = 60.0
# Address space beyond what the server has: what a damaged file makes a reader ask for is far more.
MEMORY = 6 * 2**30
HUNG = -1000


@dataclass(frozen=True)
class Process:
    """What is to run.

    Args:
        command: arguments of ``mcdenoise``; or ``reader``, a name of ``table.READERS``, and a path.
        folder: where it runs; also its home and the place of its cache.
        stdout: where its output goes; a file of its own by default.
        seconds: after so many it counts as hung.
        delay: seconds that it waits first.
        kill_after: seconds after which it gets ``signal``.
        signal: to end it with.
        largest_file: bytes that a file may have, which is how a full disk is played.
        user: whose rights it has.
        environment: further variables.
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
    environment: dict[str, str] = field(default_factory=dict)


class Ended(NamedTuple):
    """What became of it."""

    status: int
    out: str
    err: str
    seconds: float


class Server:
    """The server; it ends with the ``with`` block."""

    def __init__(self) -> None:
        # Threads of OpenMP do not outlive a fork: who waits for them afterwards waits for ever.
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        command, pipe = [sys.executable, __file__], subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment)

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()

    def run(self, *processes: Process) -> list[Ended]:
        """Start all of them at once, and wait for them."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        places = [f"{each.folder}/.output{i}" for i, each in enumerate(processes)]
        tasks = [asdict(each) | {"place": place} for each, place in zip(processes, places, strict=True)]
        self._process.stdin.write(json.dumps(tasks) + "\n")
        self._process.stdin.flush()
        answers = json.loads(self._process.stdout.readline())
        return [Ended(status, *taken(place), seconds) for (status, seconds), place in zip(answers, places, strict=True)]


def taken(place: str) -> tuple[str, str]:
    """What a process has printed to stdout and stderr; the files are removed."""
    texts = []
    for stream in ("out", "err"):
        path = Path(f"{place}.{stream}")
        # Killed before it has one, it has said nothing. Else, as it would reach the terminal.
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
                    # Those it has started go with it.
                    signal_all(child, signal.SIGKILL)
                elif now > tasks[i]["seconds"]:
                    told.add(child)
                    signal_all(child, signal.SIGKILL)
                elif tasks[i]["kill_after"] is not None and now > tasks[i]["kill_after"]:
                    tasks[i]["kill_after"] = None
                    signal_all(child, tasks[i]["signal"])
            time.sleep(0.001)
        print(json.dumps(answers), flush=True)
    # The libraries have much to say of how they are taken down.
    os._exit(0)


def signal_all(group: int, number: int) -> None:
    try:
        os.killpg(group, number)
    except ProcessLookupError:
        # Ended, or has not begun yet.
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
        os.environ |= {"HOME": task["folder"], "XDG_CACHE_HOME": f"{task['folder']}/.cache", **task["environment"]}
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

    from mcdenoise.cli import main

    try:
        if command[0] == "reader":
            return table.read(command[1], Path(command[2]))
        main(command)
    except SystemExit as stop:
        # As Python itself does: do not wait for threads.
        return int(stop.code or 0)
    return 0


if __name__ == "__main__":
    serve()
