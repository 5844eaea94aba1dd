"""Small constant tensors, made on the device of another tensor: a GPU would wait for a copy from the host."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def numbers_like(tensor: Tensor, values: Sequence[float], dtype: torch.dtype | None = None) -> Tensor:
    """``tensor.new_tensor(values)``, one fill for each; in another dtype if that is given."""
    return torch.cat([tensor.new_full((1,), value, dtype=dtype) for value in values])
