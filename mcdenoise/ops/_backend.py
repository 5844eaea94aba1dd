"""Which form of an op runs: plain torch, or the fast form of the same name in ``mcdenoise/ops/_fast``."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal, cast, get_args

import torch
from torch import Tensor
from torch.autograd import forward_ad

Backend = Literal["torch", "numba", "triton"]
BACKENDS: tuple[Backend, ...] = get_args(Backend)

_FOUND = {name: importlib.util.find_spec(name) is not None for name in ("numba", "triton")}
_EXTRAS = {"numba": "fast", "triton": "gpu"}
# Pixels of a batch below which importing numba and calling it takes longer than the plain form does.
_FEW_PIXELS = 8192
# What to take where nothing is named, of all that can run; see `preferred`.
_preferred: Backend | None = None
# Triton's interpreter computes with the memory of any device, slowly: for tests.
_INTERPRETED = os.environ.get("TRITON_INTERPRET") == "1"


def check_backend(backend: str | None) -> None:
    """``ValueError`` for an unknown backend."""
    if backend is not None and backend not in BACKENDS:
        raise ValueError(f"backend: expected one of {', '.join(BACKENDS)}, found {backend!r}")


def choose_backend(
    backend: str | None, *tensors: Tensor | None, differentiable: bool = True, forms: tuple[Backend, ...] = BACKENDS
) -> Backend:
    """The backend to run an op on ``tensors`` with.

    Args:
        backend: ``"torch"`` runs everywhere and has derivatives of any order. ``"numba"`` is compiled for the
            processor when it is first called (seconds; later processes load it from numba's cache), ``"triton"``
            likewise for an NVIDIA GPU. ``None`` takes the one of the tensors' device where it is installed and pays,
            and torch elsewhere, also while a model is exported, so that what is exported needs neither.
        tensors: the arguments of the op, the first of them ``(B, C, H, W)``.
        differentiable: whether the fast forms have derivatives.
        forms: what the op has been written in.

    Raises:
        ValueError: the backend is unknown, or cannot run; the message says why.
    """
    check_backend(backend)
    wanted = _fastest(tensors[0]) if backend is None else cast(Backend, backend)
    obstacle = _obstacle(wanted, tensors, differentiable, forms)
    if obstacle and backend is not None:
        raise ValueError(f"backend: expected one that can run here, found {backend!r}, which {obstacle}")
    return "torch" if obstacle else wanted


@contextmanager
def preferred(backend: Backend) -> Iterator[None]:
    """Within it, ops that are told no backend take this one where it can run: to measure what the choice is worth."""
    global _preferred
    check_backend(backend)
    before, _preferred = _preferred, backend
    try:
        yield
    finally:
        _preferred = before


def _fastest(image: Tensor | None) -> Backend:
    """What to take for an image if nothing is in its way."""
    if _preferred is not None:
        return _preferred
    if image is None or torch.compiler.is_exporting():
        return "torch"
    if image.device.type == "cuda":
        return "triton"
    return "torch" if image.shape[0] * image.shape[-2] * image.shape[-1] < _FEW_PIXELS else "numba"


def _obstacle(
    backend: Backend, tensors: tuple[Tensor | None, ...], differentiable: bool, forms: tuple[Backend, ...]
) -> str:
    """Why a backend cannot run on these tensors; empty if it can."""
    if backend == "torch":
        return ""
    if backend not in forms:
        return "has no form of this op"
    if _is_transformed():
        return "has no rule for torch.func, vmap or forward mode"
    given = [tensor for tensor in tensors if tensor is not None]
    for tensor in given:
        device = tensor.device
        if backend == "numba" and device.type != "cpu":
            return f"runs on the CPU, not on {device}"
        if backend == "triton" and device.type != "cuda" and not (_INTERPRETED and device.type == "cpu"):
            return f"runs on an NVIDIA GPU, not on {device}"
        if device != given[0].device:
            return f"needs all tensors on one device, and they are on {given[0].device} and {device}"
        if not differentiable and tensor.requires_grad and torch.is_grad_enabled():
            return "has no derivatives of this op"
    return _missing(backend)


def _is_transformed() -> bool:
    """Whether torch.func, ``vmap`` or forward mode is at work, of which a compiled form knows nothing."""
    if torch.compiler.is_compiling():
        return False
    return torch._C._are_functorch_transforms_active() or forward_ad._current_level >= 0


def _missing(backend: Backend) -> str:
    """Why the package of a backend cannot be imported; empty if it can."""
    # The compiler traces neither a cache nor an attempt to import.
    if torch.compiler.is_compiling() and _FOUND[backend]:
        return ""
    return _tried_import(backend)


@functools.cache
def _tried_import(backend: Backend) -> str:
    try:
        importlib.import_module(backend)
    except ImportError as error:
        return f"cannot be imported ({error}); install mcdenoise[{_EXTRAS[backend]}]"
    return ""
