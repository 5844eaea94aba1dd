"""Comparison of derivatives with difference quotients, for functions that process the images of a batch independently.

This is the comparison of ``torch.autograd.gradcheck``, with its step and its bounds. That function calls once for each
input number and once for each row of derivatives; here each of these has a copy of the images in one large batch. A
derivative that leaks from one image of a batch to another is detected as wrong in the other copy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

Function = Callable[..., tuple[Tensor, ...]]

_STEP, _ABSOLUTE, _RELATIVE = 1e-6, 1e-5, 1e-3
_AT_ONCE = 128  # copies of the images in one batch


def first_mismatch(function: Function, arguments: Sequence[Tensor]) -> str:
    """Describe the first wrong first derivative; empty if all are right.

    Args:
        function: function of float64 tensors with the same first axis, which may hold several copies of ``arguments``;
            it returns tensors of the same kind.
        arguments: the differentiable arguments, and the point of the comparison.
    """
    quotients = [_quotients(function, arguments, i) for i in range(len(arguments))]
    for j, derivatives in _derivatives(function, arguments):
        for i, found in enumerate(derivatives):
            expected = quotients[i][j].T
            beyond = ~torch.isclose(found, expected, rtol=_RELATIVE, atol=_ABSOLUTE)
            if beyond.any():
                row, column = beyond.nonzero()[0].tolist()
                return (
                    f"Jacobian mismatch for output {j} with respect to input {i}, number {row} in number {column}: "
                    f"difference quotient {expected[row, column]:.6g}, derivative {found[row, column]:.6g}"
                )
    return ""


def second_mismatch(function: Function, arguments: Sequence[Tensor]) -> str:
    """Describe the first wrong derivative of the gradients, in the arguments and in random upstream gradients.

    Args:
        function: see :func:`first_mismatch`.
        arguments: likewise.
    """
    _, results = _leaves_and_results(function, arguments)
    upstream = [2 * torch.rand_like(result) - 1 for result in results if result.requires_grad]
    count = len(arguments)

    def gradients(*tensors: Tensor) -> tuple[Tensor, ...]:
        again = torch.is_grad_enabled()
        with torch.enable_grad():
            leaves = [x if x.requires_grad else x.detach().requires_grad_() for x in tensors[:count]]
            results = [result for result in function(*leaves) if result.requires_grad]
            if not results:
                return ()
            found = torch.autograd.grad(results, leaves, tensors[count:], create_graph=again, allow_unused=True)
        return tuple(gradient for gradient in found if gradient is not None)

    return first_mismatch(gradients, [*arguments, *upstream])


@torch.no_grad()
def _quotients(function: Function, arguments: Sequence[Tensor], moved: int) -> list[Tensor]:
    """Difference quotients of each result in one argument: one row per input number, one column per output number."""
    size = arguments[moved].numel()
    rows: list[list[Tensor]] = []
    for start in range(0, size, _AT_ONCE):
        places = torch.arange(start, min(start + _AT_ONCE, size))
        copies = [_repeated(each, 2 * len(places)) for each in arguments]
        numbers = copies[moved].view(2 * len(places), size)
        numbers[0::2].scatter_add_(1, places[:, None], torch.full((len(places), 1), _STEP, dtype=numbers.dtype))
        numbers[1::2].scatter_add_(1, places[:, None], torch.full((len(places), 1), -_STEP, dtype=numbers.dtype))
        both = [result.reshape(len(places), 2, -1) for result in function(*copies)]
        rows.append([(pair[:, 0] - pair[:, 1]) / (2 * _STEP) for pair in both])
    return [torch.cat(parts) for parts in zip(*rows, strict=True)]


def _derivatives(function: Function, arguments: Sequence[Tensor]) -> list[tuple[int, list[Tensor]]]:
    """Derivatives of each result that has any, with its index, in each argument: one row per output number."""
    found = []
    for j, result in enumerate(_leaves_and_results(function, arguments)[1]):
        if not result.requires_grad:
            continue
        size = result.numel()
        rows: list[list[Tensor]] = []
        for start in range(0, size, _AT_ONCE):
            upstream = torch.eye(size, dtype=result.dtype)[start : start + _AT_ONCE]
            leaves, results = _leaves_and_results(function, [_repeated(each, len(upstream)) for each in arguments])
            given = upstream.reshape(results[j].shape)
            gradients = torch.autograd.grad(results[j], leaves, given, allow_unused=True, materialize_grads=True)
            rows.append([gradient.detach().reshape(len(upstream), -1) for gradient in gradients])
        found.append((j, [torch.cat(parts) for parts in zip(*rows, strict=True)]))
    return found


def _leaves_and_results(function: Function, arguments: Sequence[Tensor]) -> tuple[list[Tensor], tuple[Tensor, ...]]:
    with torch.enable_grad():
        leaves = [each.detach().clone().requires_grad_() for each in arguments]
        return leaves, function(*leaves)


def _repeated(tensor: Tensor, copies: int) -> Tensor:
    return tensor.detach().repeat(copies, *(1,) * (tensor.ndim - 1))
