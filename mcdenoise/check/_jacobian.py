"""Jacobians against finite differences, for functions that treat the images of a batch identically and independently.

This makes the same comparison as ``torch.autograd.gradcheck``, with the same step and tolerances. ``gradcheck`` calls
the function for each perturbed element and each row of the Jacobian; here each of them has its own copy of the images
in one large batch. If gradients leak between the images of a batch, the Jacobian of the copies is wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

Function = Callable[..., tuple[Tensor, ...]]

_STEP, _ABSOLUTE, _RELATIVE = 1e-6, 1e-5, 1e-3
_AT_ONCE = 128  # copies of the images in one batch


def first_mismatch(function: Function, arguments: Sequence[Tensor]) -> str:
    """The first mismatch of first derivatives, or an empty string.

    Args:
        function: takes float64 tensors with the same first axis, which may contain several copies of the images of
            ``arguments``, and returns tensors of the same kind.
        arguments: the point at which the derivatives in all of them are checked.
    """
    quotients = [_quotients(function, arguments, i) for i in range(len(arguments))]
    for j, derivatives in _derivatives(function, arguments):
        for i, found in enumerate(derivatives):
            expected = quotients[i][j].T
            beyond = ~torch.isclose(found, expected, rtol=_RELATIVE, atol=_ABSOLUTE)
            if beyond.any():
                row, column = beyond.nonzero()[0].tolist()
                return (
                    f"Jacobian mismatch for output {j} with respect to input {i}: element {row} of the output in "
                    f"element {column} of the input has the difference quotient {expected[row, column]:.6g} and the "
                    f"derivative {found[row, column]:.6g}"
                )
    return ""


def second_mismatch(function: Function, arguments: Sequence[Tensor]) -> str:
    """The first mismatch of the gradients' derivatives in the arguments and in random upstream gradients, or empty.

    Args:
        function: see :func:`first_mismatch`.
        arguments: see :func:`first_mismatch`.
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

    message = first_mismatch(gradients, [*arguments, *upstream])
    return message and f"second derivatives: {message}"


def one_by_one(function: Function) -> Function:
    """The function for arguments with one more axis in front; it is called for each item of that axis separately."""

    def called(*tensors: Tensor) -> tuple[Tensor, ...]:
        results = [function(*items) for items in zip(*tensors, strict=True)]
        return tuple(map(torch.stack, zip(*results, strict=True)))

    return called


@torch.no_grad()
def _quotients(function: Function, arguments: Sequence[Tensor], moved: int) -> list[Tensor]:
    """Finite differences of each result in one argument: a row per perturbed element, a column per element."""
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
    """Jacobians of each differentiable result, with its index, in each argument: a row per element of the result."""
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
