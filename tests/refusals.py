"""What is refused, and in which words: one line, and nothing of Python's own."""

import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
