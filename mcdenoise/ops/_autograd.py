"""``torch.autograd.Function`` with a typed call."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor


class Function(torch.autograd.Function):
    """A function of tensors with one result and derivatives of its own."""

    if TYPE_CHECKING:
        # torch leaves `apply` untyped, which a strict type checker takes for an untyped call.
        @classmethod
        def apply(cls, *args: Any) -> Tensor: ...
