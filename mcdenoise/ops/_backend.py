"""Which implementation of an op runs: plain torch, or the function of the same name in ``_numba/``."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Literal, get_args

import torch
from torch import Tensor
from torch.autograd import forward_ad

Backend = Literal["torch", "numba"]
BACKENDS: tuple[Backend, ...] = get_args(Backend)

# Pixels of a batch below which importing numba and calling it takes longer than the reference implementation does.
_FEW_PIXELS = 8192


# The backend of :func:`use`, and whether an op that cannot run in it raises.
_used: ContextVar[tuple[Backend, bool] | None] = ContextVar("mcdenoise.ops.use", default=None)


def choose_backend(backends: Sequence[Backend], tensors: Sequence[Tensor]) -> Backend:
    """The backend to run an op on ``tensors`` with: the fastest that can run and pays, or the one of :func:`use`.

    Args:
        backends: names of the fast backends that the op has.
        tensors: the arguments of the op, ``(B, C, H, W)`` or with other axes behind the second.

    Raises:
        ValueError: the backend of :func:`use` cannot run; the message says why.
    """
    pixels = max((tensor.shape[:1].numel() * tensor.shape[2:].numel() for tensor in tensors), default=0)
    fastest: Backend = "torch" if pixels < _FEW_PIXELS else "numba"
    wanted, strict = _used.get() or (fastest, False)
    obstacle = _obstacle(tensors, backends) if wanted == "numba" else ""
    if obstacle and strict:
        raise ValueError(f"backend: expected one that can run here, found {wanted!r}, which {obstacle}")
    return "torch" if obstacle else wanted


@contextmanager
def use(backend: Backend, *, strict: bool = True) -> Iterator[None]:
    """Run all ops that have this backend in it, within the context: in this thread, or in this task of asyncio.

    Args:
        backend: ``"torch"`` is plain torch, which runs everywhere and has derivatives of any order. ``"numba"`` is
            compiled for the processor when it is first called (seconds; later processes load it from numba's cache),
            and has no derivatives. Without this the fastest is taken that can run. ``torch.compile`` and
            ``torch.export`` see plain torch only.
        strict: whether an op that cannot run in it raises, with the reason; otherwise that op runs in plain torch.

    Raises:
        ValueError: the backend is unknown; or, strictly, one of the ops within cannot run in it.

    Example:
        >>> from mcdenoise import ops
        >>> with ops.use("torch"):
        ...     half = ops.downsample(torch.ones(1, 3, 4, 4))
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend: expected one of {', '.join(BACKENDS)}, found {backend!r}")
    token = _used.set((backend, strict))
    try:
        yield
    finally:
        _used.reset(token)


def _obstacle(tensors: Sequence[Tensor], backends: Sequence[Backend]) -> str:
    """Why numba cannot run on these tensors; empty if it can."""
    if "numba" not in backends:
        return "has no form of this op"
    if is_transformed():
        return "has no rule for torch.func, vmap or forward mode"
    # As in make_fx and with fake tensors: a graph would contain one result as a constant.
    if torch._C._is_tracing() or torch._C._len_torch_dispatch_stack() > 0:
        return "is seen by no tracing and by no dispatch mode"
    for tensor in tensors:
        if tensor.device.type != "cpu":
            return f"runs on the CPU, not on {tensor.device}"
        if tensor.requires_grad and torch.is_grad_enabled():
            return "has no derivatives of this op"
    return _missing()


def is_transformed() -> bool:
    """Whether a transform of ``torch.func``, or forward mode, needs a rule for every operation, even without grad."""
    return torch._C._are_functorch_transforms_active() or forward_ad._current_level >= 0


@functools.cache
def _missing() -> str:
    """Why numba cannot be imported; empty if it can."""
    try:
        # With what all its kernels need, as the memory of the process may end here.
        importlib.import_module("mcdenoise.ops._numba._runtime")
    except Exception as error:  # from a damaged file of settings to too little memory
        reason = f"cannot be imported ({' '.join(str(error).split()) or type(error).__name__})"
        if importlib.util.find_spec("numba") is not None:
            warnings.warn(f"numba {reason}: plain torch is used, which is slower", stacklevel=2)
        return f"{reason}; install mcdenoise[fast]"
    return ""
