"""Functions that workers call: they leave marks in a folder, and may kill their own process."""

import os
import signal
from pathlib import Path


def mark(folder: Path, name: str) -> str:
    (folder / name).write_text(str(os.getpid()))
    return name


def die_at_first(folder: Path, name: str, times: int = 1) -> str:
    tries = sorted(folder.glob(f"{name}.try*"))
    if len(tries) < times:
        mark(folder, f"{name}.try{len(tries)}")
        os.kill(os.getpid(), signal.SIGKILL)
    return mark(folder, name)


def fail(message: str) -> None:
    raise RuntimeError(message)


class Strange(Exception):
    """An error that cannot be made again from its text."""

    def __init__(self, one: int, other: int) -> None:
        super().__init__(f"{one} and {other}")


def fail_strangely() -> None:
    raise Strange(7, 8)
