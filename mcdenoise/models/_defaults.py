"""Torch's settings of the process for constructing models: dtype, device, also one without memory, random numbers."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode

# The default dtype belongs to the process: the first of several threads stores it, and the last one restores it.
_lock, _inside = threading.Lock(), list[torch.dtype]()
_drawing = threading.RLock()


@contextmanager
def plain_defaults() -> Iterator[None]:
    """Make float32 and the CPU the defaults inside this block, whatever the program's defaults are."""
    with _lock:
        _inside.append(torch.get_default_dtype())
        torch.set_default_dtype(torch.float32)
    try:
        # Skip the context managers, which slow down every call, where the defaults are these already.
        with nullcontext() if torch.get_default_device().type == "cpu" else torch.device("cpu"):
            yield
    finally:
        with _lock:
            # Every later one found float32: the first one's is the program's, whichever of them ends first.
            before = _inside.pop()
            if not _inside:
                torch.set_default_dtype(before)


@contextmanager
def without_draws() -> Iterator[None]:
    """Leave the program's random numbers as they are, although layers draw their first weights from them."""
    with _drawing, torch.random.fork_rng(devices=[]):
        yield


@contextmanager
def outlined() -> Iterator[None]:
    """Make float32 and a device without memory the defaults inside this block: tensors have shapes and no values."""
    with plain_defaults(), torch.device("meta"), _Undrawn():
        yield


class _Undrawn(TorchFunctionMode):
    """Draw no values of such tensors, for which torch would load a thousand modules."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return args[0] if func in (Tensor.normal_, Tensor.uniform_) else func(*args, **(kwargs or {}))
