"""Derivatives of a fast form by way of its plain form, where they are to be differentiated again."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor


def plain_gradients(
    function: Callable[..., Tensor], tensors: Sequence[Tensor | None], needed: Sequence[bool], gradient: Tensor
) -> list[Tensor | None]:
    """Of ``function(*tensors)``, times ``gradient``, for the tensors that need one; on record."""
    with torch.enable_grad():
        # An argument may be computed from another one, and only its direct part is asked for: hence the aliases.
        aliases = [None if tensor is None else tensor.view_as(tensor) for tensor in tensors]
        wanted = [alias for alias, need in zip(aliases, needed, strict=True) if alias is not None and need]
        found = iter(
            torch.autograd.grad(function(*aliases), wanted, gradient, create_graph=True, materialize_grads=True)
        )
        return [
            next(found) if alias is not None and need else None for alias, need in zip(aliases, needed, strict=True)
        ]
