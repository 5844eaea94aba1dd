"""Numerical stability: ops, models and the whole denoiser on stiff and extreme inputs, and over thousands of frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import torch

from mcdenoise.stability import _denoiser, _long_runs, _models, _ops
from mcdenoise.stability._check import DTYPES, Check, Summary, parse_dtypes, summarize
from mcdenoise.stability._denoiser import check_denoiser
from mcdenoise.stability._long_runs import FRAMES, LongRun, long_runs
from mcdenoise.stability._models import check_model
from mcdenoise.stability._ops import check_case, check_op

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
        ops: names of ops; ``None`` means all, or none where models are named.
        models: names of models with shipped weights, each also within a denoiser; ``None`` means all (and a denoiser of
            the first), or none where ops are named.
        dtypes: the dtypes to try each in.
        frames: length of the long runs, which belong to the whole run only.

    Raises:
        InputError: there is no such op, or no shipped weights of such a model.
    """
    everything = ops is None and models is None
    chosen_ops = _ops.select(ops) if everything or ops is not None else []
    chosen_models = _models.select(models) if everything or models is not None else []
    within = chosen_models[:1] if models is None else chosen_models
    return [
        *(Stage(op.name, partial(_ops.check_op, op, dtypes)) for op in chosen_ops),
        *(Stage(name, partial(_models.check_model, name, dtypes)) for name in chosen_models),
        *(Stage(f"Denoiser, {name}", partial(_denoiser.check_denoiser, name, dtypes)) for name in within),
        *([Stage("long runs", partial(_long_runs.long_runs, dtypes, frames))] if everything else []),
    ]


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
