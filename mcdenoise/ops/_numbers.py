"""Constants of a few numbers beside a tensor, made where it is: what comes from the host is waited for by a GPU."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def numbers_like(tensor: Tensor, values: Sequence[float], dtype: torch.dtype | None = None) -> Tensor:
    """``tensor.new_tensor(values)``, one fill for each; in another dtype if that is given."""
    return torch.cat([tensor.new_full((1,), value, dtype=dtype) for value in values])
