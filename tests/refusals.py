"""What is refused, and in which words: one line, and nothing of Python's own."""

import os
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from mcdenoise.errors import InputError


def refused(action: Callable[..., object], *arguments: Any, **options: Any) -> str:
    """The one line in which an action is refused."""
    with pytest.raises(InputError) as error:
        action(*arguments, **options)
    message = str(error.value)
    assert "\n" not in message
    assert "[Errno" not in message
    return message


@contextmanager
def full_disk(size: int) -> Iterator[None]:
    """The system refuses longer files, as it refuses to write to a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def put_no_file(what: str, path: Path) -> None:
    """Put something that is no file of sensible size at a path."""
    path.unlink(missing_ok=True)
    if what == "pipe":
        os.mkfifo(path)
    elif what == "folder":
        path.mkdir()
    elif what in ("empty", "huge"):
        path.touch()
        os.truncate(path, 1 << 42 if what == "huge" else 0)
    elif what != "nothing":
        path.symlink_to({"device": "/dev/zero", "terminal": "/dev/ptmx", "link": "nothing", "loop": path.name}[what])
