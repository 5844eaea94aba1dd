"""Small tensors, made on the device of another tensor: a GPU would wait for a copy from the host."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def numbers_like(tensor: Tensor, values: Sequence[float]) -> Tensor:
    """``tensor.new_tensor(values)``, one fill for each."""
    return torch.cat([tensor.new_full((1,), value) for value in values])


def unit_of(largest: Tensor) -> Tensor:
    """The power of two by which numbers are divided so that the largest is in [1, 2), which rounds nothing; 1 for 0."""
    # ONNX has no mantissas, so exported graphs divide by the number itself. Half of it, as 2^128 is infinite.
    power = largest if torch.compiler.is_exporting() else largest / (2 * torch.frexp(largest).mantissa)
    return torch.where(largest > 0, power, 1)
