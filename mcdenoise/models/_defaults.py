"""Torch's own default dtype and device, for constructing models, and a device without memory for their shapes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode


@contextmanager
def plain_defaults() -> Iterator[None]:
    """Make float32 and the CPU the defaults inside this block, whatever the program's defaults are."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        # Skip the context managers, which slow down every call, where the defaults are these already.
        with nullcontext() if torch.get_default_device().type == "cpu" else torch.device("cpu"):
            yield
    finally:
        torch.set_default_dtype(before)


@contextmanager
def outlined() -> Iterator[None]:
    """Make float32 and a device without memory the defaults inside this block: tensors have shapes and no values."""
    with plain_defaults(), torch.device("meta"), _Undrawn():
        yield


class _Undrawn(TorchFunctionMode):
    """Draw no values of such tensors, for which torch would load a thousand modules."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return args[0] if func in (Tensor.normal_, Tensor.uniform_) else func(*args, **(kwargs or {}))
