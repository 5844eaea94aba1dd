"""Which implementation of an op runs: the reference, or that of the same name in ``_numba/``."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import threading
import warnings
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from typing import Literal, get_args

import torch
from torch import Tensor
from torch.autograd import forward_ad

Backend = Literal["torch", "numba"]
BACKENDS: tuple[Backend, ...] = get_args(Backend)

_FOUND = importlib.util.find_spec("numba") is not None
# Pixels of a batch below which importing numba and calling it takes longer than the reference implementation does.
_FEW_PIXELS = 8192


class _Used(threading.local):
    """The backend of :func:`use` in this thread, and whether an op that cannot run in it raises."""

    choice: tuple[Backend, bool] | None = None


# Torch's compiler traces it, which it cannot do with a ContextVar.
_used = _Used()


def check_backend(backend: str | None) -> None:
    """``ValueError`` for an unknown backend."""
    if backend is not None and backend not in BACKENDS:
        raise ValueError(f"backend: expected one of {', '.join(BACKENDS)}, found {backend!r}")


def choose_backend(
    backends: Sequence[Backend], tensors: Sequence[Tensor], *, differentiable: Collection[Backend] = ()
) -> Backend:
    """The backend to run an op on ``tensors`` with: the fastest that can run and pays, or the one of :func:`use`.

    Args:
        backends: names of the fast backends that the op has.
        tensors: the arguments of the op, ``(B, C, H, W)`` or with other axes behind the second.
        differentiable: those of the backends that have derivatives.

    Raises:
        ValueError: the backend of :func:`use` cannot run; the message says why.
    """
    wanted, strict = _used.choice or (_fastest(tensors), False)
    obstacle = _obstacle(wanted, tensors, wanted in differentiable, backends)
    if obstacle and strict:
        raise ValueError(f"backend: expected one that can run here, found {wanted!r}, which {obstacle}")
    return "torch" if obstacle else wanted


@contextmanager
def use(backend: Backend, *, strict: bool = True) -> Iterator[None]:
    """Run all ops of this thread that have this backend in it, within the context.

    Args:
        backend: ``"torch"`` is plain torch, which runs everywhere and has derivatives of any order. ``"numba"`` is
            compiled for the processor when it is first called (seconds; later processes load it from numba's cache).
            Without this the fastest is taken that can run.
        strict: whether an op that cannot run in it raises, with the reason; otherwise that op runs in plain torch.

    Raises:
        ValueError: the backend is unknown; or, strictly, one of the ops within cannot run in it.

    Example:
        >>> from mcdenoise import ops
        >>> with ops.use("torch"):
        ...     half = ops.downsample(torch.ones(1, 3, 4, 4))
    """
    check_backend(backend)
    before, _used.choice = _used.choice, (backend, strict)
    try:
        yield
    finally:
        _used.choice = before


@contextmanager
def one_backend(image: Tensor) -> Iterator[None]:
    """Choose the backend of all ops within the context by the size of this image, not by that of their arguments.

    A part of an image, or a coarser scale of it, must not be computed otherwise than the whole.

    Args:
        image: ``(B, C, H, W)``.
    """
    with nullcontext() if _used.choice is not None else use(_fastest([image]), strict=False):
        yield


def _fastest(images: Sequence[Tensor]) -> Backend:
    """The backend that is fastest for images, of which the largest counts, if it can run."""
    if not images or torch.compiler.is_exporting():
        return "torch"
    pixels = max(image.shape[:1].numel() * image.shape[2:].numel() for image in images)
    return "torch" if pixels < _FEW_PIXELS else "numba"


def _obstacle(backend: Backend, tensors: Sequence[Tensor], differentiable: bool, backends: Sequence[Backend]) -> str:
    """Why a backend cannot run on these tensors; empty if it can."""
    if backend == "torch":
        return ""
    if backend not in backends:
        return "has no form of this op"
    if _is_transformed():
        return "has no rule for torch.func, vmap or forward mode"
    for tensor in tensors:
        device = tensor.device
        if device.type != "cpu":
            return f"runs on the CPU, not on {device}"
        if not differentiable and tensor.requires_grad and torch.is_grad_enabled():
            return "has no derivatives of this op"
    return _missing()


def _is_transformed() -> bool:
    """Whether torch.func, ``vmap`` or forward mode is at work, of which a fast backend knows nothing."""
    if torch.compiler.is_compiling():
        return False
    return torch._C._are_functorch_transforms_active() or forward_ad._current_level >= 0


def _missing() -> str:
    """Why numba cannot be imported; empty if it can."""
    # The compiler traces neither a cache nor an attempt to import.
    if torch.compiler.is_compiling() and _FOUND:
        return ""
    return _tried_import()


@functools.cache
def _tried_import() -> str:
    try:
        # With what all its kernels need, as the memory of the process may end here.
        importlib.import_module("mcdenoise.ops._numba._runtime")
    except Exception as error:  # from a damaged file of settings to too little memory
        reason = f"cannot be imported ({' '.join(str(error).split()) or type(error).__name__})"
        if _FOUND:
            warnings.warn(f"numba {reason}: plain torch is used, which is slower", stacklevel=2)
        return f"{reason}; install mcdenoise[fast]"
    return ""
