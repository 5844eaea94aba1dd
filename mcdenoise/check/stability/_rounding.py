"""Rounding errors by experiment: every step of a computation in float64 is rounded at random, as a shorter dtype would.

This is Monte Carlo arithmetic (Parker 1997, "Monte Carlo arithmetic: exploiting randomness in floating-point
arithmetic"): it shows how much of a result is known when each of its steps is rounded. Gradients need it. Their terms
cancel, as those of a quotient's derivative do, and which ones is known to autograd alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree
from torch.utils._python_dispatch import TorchDispatchMode

# Numbers are only moved, compared or counted.
_EXACT = {
    *("clone", "copy_", "_to_copy", "cat", "stack", "gather", "index", "index_select", "repeat", "flip", "roll"),
    *("constant_pad_nd", "replication_pad2d", "max_pool2d_with_indices", "amax", "amin", "max", "min", "where"),
    *("floor", "round", "ceil", "trunc", "sign", "frexp", "maximum", "minimum", "clamp", "clamp_min", "clamp_max"),
    *("slice_backward", "select_backward", "zeros_like", "ones_like", "full_like", "new_zeros", "new_full", "zero_"),
    *("empty_like", "new_empty", "new_ones", "fill_", "fill", "neg", "abs", "relu", "im2col", "im2col_backward"),
    *("scalar_tensor", "lift_fresh", "detach", "alias", "upsample_nearest2d", "masked_fill", "unfold", "diff"),
}

_POOL = 2**18


class Rounded(TorchDispatchMode):
    """Rounds the result of every step at random, by up to ``unit`` relatively; and its terms, where it adds many up.

    Numbers below the smallest normal one of ``dtype`` may become 0. Convolutions may have a larger unit.
    """

    def __init__(self, dtype: torch.dtype, unit: float, convolutions: float = 0.0) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._tiny, self._unit, self._convolutions = torch.finfo(dtype).tiny, unit, max(unit, convolutions)
        self._generator = torch.Generator().manual_seed(0)
        self._start, self._signs = 0, self._drawn(_POOL)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run one step."""
        returns = func._schema.returns
        writes = any(each.alias_info is not None and each.alias_info.is_write for each in returns)
        views = any(each.alias_info is not None for each in returns) and not writes
        if views or func._overloadpacket.__name__ in _EXACT:
            return func(*args, **(kwargs or {}))
        unit = self._convolutions if func._overloadpacket.__name__ == "convolution" else self._unit
        moved = partial(self.rounded, unit=unit)
        if torch.Tag.pointwise not in func.tags and not writes:
            args = pytree.tree_map_only(Tensor, moved, args)
        result = func(*args, **(kwargs or {}))
        if writes:
            result.mul_(self._factor(result, unit)) if result.is_floating_point() else None
            return result
        return pytree.tree_map_only(Tensor, moved, result)

    def rounded(self, tensor: Tensor, unit: float = 0.0) -> Tensor:
        """The numbers, moved by the unit, by default that of all steps but convolutions."""
        if not tensor.is_floating_point() or not tensor.ndim:
            return tensor
        return tensor * self._factor(tensor, unit or self._unit)

    def _factor(self, tensor: Tensor, unit: float) -> Tensor:
        # Drawing numbers takes longer than most steps, so signs are drawn ahead.
        count = tensor.numel()
        self._start = (self._start + 7919) % _POOL
        signs = self._signs[self._start : self._start + count] if self._start + count <= _POOL else self._drawn(count)
        signs = signs.view(tensor.shape)
        return 1 + torch.where(tensor.abs() < self._tiny, signs, unit * signs)

    def _drawn(self, count: int) -> Tensor:
        return torch.randint(0, 2, (count,), generator=self._generator, dtype=torch.float64) * 2 - 1


def spread(
    function: Callable[[Sequence[Tensor]], list[Tensor]],
    leaves: Sequence[Tensor],
    dtype: torch.dtype,
    draws: int,
    factor: float,
) -> list[Tensor]:
    """How much each result changes when every step is rounded to ``dtype``: the largest change of all draws.

    Args:
        function: treats the images of a batch alike and independently.
        leaves: its arguments, in float64.
        dtype: to which to round.
        draws: number of experiments, all in one batch.
        factor: multiple of the unit roundoff by which to change.
    """
    exact = function(leaves)
    copies = [leaf.repeat(draws, *(1,) * (leaf.ndim - 1)) for leaf in leaves]
    # The arguments too: where they are close to a jump, another result is as good.
    mode = Rounded(dtype, factor * torch.finfo(dtype).eps / 2)
    copies = [mode.rounded(copy) for copy in copies]
    with mode:
        rounded = function(copies)
    return [
        (each.reshape(draws, *value.shape) - value).abs().nan_to_num(nan=torch.inf, posinf=torch.inf).amax(0)
        for each, value in zip(rounded, exact, strict=True)
    ]
