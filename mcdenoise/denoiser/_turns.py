"""One thread at a time for each denoiser, and none that a process was forked from."""

from __future__ import annotations

import functools
import os
import threading
from collections.abc import Callable
from typing import Any, Concatenate, ParamSpec, TypeVar
from weakref import WeakKeyDictionary

import torch

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")
# The locks are not in the denoisers, which can be copied to another process.
_locks: WeakKeyDictionary[object, threading.RLock] = WeakKeyDictionary()
# The process, if it has denoised frames, and so may have started threads of torch.
started: set[int] = set()


def in_turn(
    method: Callable[Concatenate[Any, _Arguments], _Result],
) -> Callable[Concatenate[Any, _Arguments], _Result]:
    """Run a denoiser's methods in one thread at a time."""

    @functools.wraps(method)
    def alone(denoiser: Any, /, *arguments: _Arguments.args, **settings: _Arguments.kwargs) -> _Result:
        with _locks.setdefault(denoiser, threading.RLock()):
            return method(denoiser, *arguments, **settings)

    return alone


def _after_fork() -> None:
    """Make a forked process independent of its parent's threads: it has none of them, and would wait for them."""
    _locks.clear()
    if started:
        torch.set_num_threads(1)
    started.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
