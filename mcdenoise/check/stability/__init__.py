"""Numerical stability of ops, models and the denoiser, on stiff and extreme inputs and over thousands of frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import torch

from mcdenoise.check.case import DTYPES
from mcdenoise.check.own import find_ops, note_of
from mcdenoise.check.stability._check import LONG_RUNS, Check
from mcdenoise.check.stability._denoiser import VALID_SHOT, check_denoiser
from mcdenoise.check.stability._long_runs import FRAMES, long_runs
from mcdenoise.check.stability._models import check_model
from mcdenoise.check.stability._ops import check_case, check_op, check_stability
from mcdenoise.errors import InputError
from mcdenoise.methods import parse_method
from mcdenoise.models import list_models

__all__ = [
    "DTYPES",
    "FRAMES",
    "LONG_RUNS",
    "VALID_SHOT",
    "Check",
    "Group",
    "check_case",
    "check_denoiser",
    "check_model",
    "check_op",
    "check_stability",
    "groups",
    "long_runs",
]


@dataclass(frozen=True)
class Group:
    """A group of checks.

    Args:
        name: of the op, the model or the denoiser that is checked.
        run: runs the checks.
        note: what is not checked, in one line; usually empty.
    """

    name: str
    run: Callable[[], Iterable[Check]]
    note: str = ""


def groups(
    ops: Sequence[str] | None = None,
    models: Sequence[str] | None = None,
    dtypes: Sequence[torch.dtype] = DTYPES,
    frames: int = FRAMES,
) -> list[Group]:
    """The groups of checks: ops, then models, then the denoiser, then long runs.

    Args:
        ops: names of ops, or functions of your own, ``path/to/file.py:function``, see
            :func:`mcdenoise.check.own.find_ops`; ``None`` means all ops, or none if models are named.
        models: models, see :func:`mcdenoise.methods.parse_method`. Each is checked in a denoiser, and trainable ones
            also by themselves. ``None`` means all models whose packages are installed and whose weights are shipped, or
            none if ops are named.
        dtypes: the dtypes to check.
        frames: number of frames of the long runs, which are included if neither ops nor models are named.

    Raises:
        InputError: there is no such op, or a named model is not available.
    """
    everything = ops is None and models is None
    chosen_ops = find_ops(ops) if everything or ops is not None else []
    chosen_models = _available(models) if everything or models is not None else []
    return [
        *(Group(op.name, partial(check_op, op, dtypes), note_of(op)) for op in chosen_ops),
        *(Group(name, partial(check_model, name, dtypes)) for name in chosen_models),
        *(Group(f"Denoiser, {name}", partial(check_denoiser, name, dtypes)) for name in chosen_models),
        *([Group(LONG_RUNS, partial(long_runs, dtypes, frames))] if everything else []),
    ]


def _available(names: Sequence[str] | None) -> list[str]:
    """The available models; ``InputError`` if a named one is not."""
    found = []
    for name in list_models() if names is None else names:
        try:
            parse_method(name).denoiser()
        except InputError:
            if names is not None:
                raise
            continue
        found.append(name)
    return found
