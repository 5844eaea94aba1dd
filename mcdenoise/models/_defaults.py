"""What models are made of, whatever torch's defaults are in the process that makes them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

import torch


@contextmanager
def plain_defaults() -> Iterator[None]:
    """Within this, what names neither a dtype nor a device is float32 on the CPU, as weights are stored."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        # Where it is that already, nothing is slowed down.
        with nullcontext() if torch.get_default_device().type == "cpu" else torch.device("cpu"):
            yield
    finally:
        torch.set_default_dtype(before)
