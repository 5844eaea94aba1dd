"""Numerical stability: ops, models and the whole denoiser on stiff and extreme inputs, and over thousands of frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import torch

from mcdenoise.check.stability import _denoiser, _long_runs, _models, _ops
from mcdenoise.check.stability._check import DTYPES, Check, Summary, parse_dtypes, summarize
from mcdenoise.check.stability._denoiser import check_denoiser
from mcdenoise.check.stability._long_runs import FRAMES, LongRun, long_runs
from mcdenoise.check.stability._models import check_model
from mcdenoise.check.stability._ops import check_case, check_op, check_stability
from mcdenoise.errors import InputError
from mcdenoise.methods import parse_method
from mcdenoise.models import list_models

__all__ = [
    "DTYPES",
    "FRAMES",
    "Check",
    "LongRun",
    "Stage",
    "Summary",
    "as_json",
    "check_case",
    "check_denoiser",
    "check_model",
    "check_op",
    "check_stability",
    "long_runs",
    "parse_dtypes",
    "stages",
    "summarize",
]


@dataclass(frozen=True)
class Stage:
    """A part of the whole run.

    Args:
        name: what it is about.
        run: makes its checks, or its long runs.
    """

    name: str
    run: Callable[[], Iterable[Check | LongRun]]


def stages(
    ops: Sequence[str] | None = None,
    models: Sequence[str] | None = None,
    dtypes: Sequence[torch.dtype] = DTYPES,
    frames: int = FRAMES,
) -> list[Stage]:
    """What there is to check: ops, then models, then the denoiser, then long runs.

    Args:
        ops: names of ops, or functions of one's own, ``path/to/file.py:function``; ``None`` means all ops, or none
            where models are named.
        models: spellings of models, see :func:`mcdenoise.methods.parse_method`, each within a denoiser, and what learns
            also by itself; ``None`` means the whole zoo but what needs a package that is not installed or has no
            shipped weights, or none where ops are named.
        dtypes: the dtypes to try each in.
        frames: length of the long runs, which belong to the whole run only.

    Raises:
        InputError: there is no such op, or such a model cannot be had.
    """
    everything = ops is None and models is None
    chosen_ops = _ops.select(ops) if everything or ops is not None else []
    chosen_models = _available(models) if everything or models is not None else []
    return [
        *(Stage(op.name, partial(_ops.check_op, op, dtypes)) for op in chosen_ops),
        *(Stage(name, partial(_models.check_model, name, dtypes)) for name in chosen_models),
        *(Stage(f"Denoiser, {name}", partial(_denoiser.check_denoiser, name, dtypes)) for name in chosen_models),
        *([Stage("long runs", partial(_long_runs.long_runs, dtypes, frames))] if everything else []),
    ]


def _available(names: Sequence[str] | None) -> list[str]:
    """Models that can be had; of those that are named, every one."""
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


def as_json(checks: Sequence[Check], runs: Sequence[LongRun]) -> dict[str, Any]:
    """Everything found, for a JSON file; what is infinite or no number becomes ``null``."""
    return {
        "passed": all(check.passed for check in checks) and all(run.passed for run in runs),
        "checks": [{name: _number(value) for name, value in asdict(check).items()} for check in checks],
        "long_runs": [
            {**asdict(run), "errors": [_number(error) for error in run.errors], "allowed": _number(run.allowed)}
            for run in runs
        ],
    }


def _number(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
