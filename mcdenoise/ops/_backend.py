"""Which form of an op runs: plain torch, or the fast form of the same name in ``mcdenoise/ops/_fast``."""

from __future__ import annotations

import functools
import importlib.util
from typing import Literal, get_args

import torch
from torch import Tensor

Backend = Literal["torch", "numba"]
BACKENDS: tuple[Backend, ...] = get_args(Backend)

_FOUND = importlib.util.find_spec("numba") is not None
# Pixels of a batch below which importing numba and calling it takes longer than the plain form does.
_FEW_PIXELS = 8192


def check_backend(backend: str | None) -> None:
    """``ValueError`` for an unknown backend."""
    if backend is not None and backend not in BACKENDS:
        raise ValueError(f"backend: expected one of {', '.join(BACKENDS)}, found {backend!r}")


def choose_backend(backend: str | None, *tensors: Tensor | None, differentiable: bool = True) -> Backend:
    """The backend to run an op on ``tensors`` with.

    Args:
        backend: ``"torch"`` runs everywhere and has derivatives of any order. ``"numba"`` is compiled for the
            processor when it is first called (seconds; later processes load it from numba's cache). ``None`` takes
            numba where it is installed and pays, and torch elsewhere, also while a model is exported, so that what is
            exported needs neither.
        tensors: the arguments of the op, the first of them ``(B, C, H, W)``.
        differentiable: whether the fast form has derivatives.

    Raises:
        ValueError: the backend is unknown, or cannot run; the message says why.
    """
    check_backend(backend)
    if backend == "torch":
        return "torch"
    if backend is None:
        first = tensors[0]
        few = first is None or first.shape[0] * first.shape[-2] * first.shape[-1] < _FEW_PIXELS
        if few or torch.compiler.is_exporting():
            return "torch"
        return "torch" if _obstacle(tensors, differentiable) else "numba"
    obstacle = _obstacle(tensors, differentiable)
    if obstacle:
        raise ValueError(f"backend: expected one that can run here, found 'numba', which {obstacle}")
    return "numba"


def _obstacle(tensors: tuple[Tensor | None, ...], differentiable: bool) -> str:
    """Why numba cannot run on these tensors; empty if it can."""
    for tensor in tensors:
        if tensor is None:
            continue
        if tensor.device.type != "cpu":
            return f"runs on the CPU, not on {tensor.device}"
        if not differentiable and tensor.requires_grad and torch.is_grad_enabled():
            return "has no derivatives of this op"
    return _no_numba()


def _no_numba() -> str:
    """Why numba cannot be imported; empty if it can."""
    # The compiler traces neither a cache nor an attempt to import.
    if torch.compiler.is_compiling() and _FOUND:
        return ""
    return _tried_import()


@functools.cache
def _tried_import() -> str:
    try:
        import numba  # noqa: F401
    except ImportError as error:
        return f"cannot be imported ({error}); install mcdenoise[fast]"
    return ""
