"""Results of stability checks, and the dtypes in which they run."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch

from mcdenoise.errors import InputError

DTYPES = (torch.float32, torch.bfloat16, torch.float16)


@dataclass(frozen=True)
class Check:
    """Result of one check.

    Args:
        subject: the op, the model or the denoiser.
        case: name of the inputs.
        dtype: such as ``"float32"``.
        backend: backend of an op; ``""`` if it has only one.
        what: the property that was checked, such as ``"forward"`` or ``"constant"``.
        error: the error closest to its bound, in units of the dtype's epsilon times the condition number.
        allowed: its bound by error analysis, in the same units.
        condition: maximum condition number of the case: the factor by which it magnifies relative input changes.
        passed: whether the property holds.
        message: description of a failure; empty if the check passed.
    """

    subject: str
    case: str
    dtype: str
    backend: str
    what: str
    error: float
    allowed: float
    condition: float
    passed: bool
    message: str = ""


@dataclass(frozen=True)
class Summary:
    """The checks of one kind of one subject in one dtype, worst first.

    Args:
        subject: see :class:`Check`.
        dtype: see :class:`Check`.
        backend: see :class:`Check`.
        what: see :class:`Check`.
        checks: number of checks.
        worst: the check that is closest to its bound, or furthest beyond it.
        condition: maximum condition number of all.
        failed: the failed checks.
    """

    subject: str
    dtype: str
    backend: str
    what: str
    checks: int
    worst: Check
    condition: float
    failed: tuple[Check, ...]


def summarize(checks: Iterable[Check]) -> list[Summary]:
    """Group checks by subject, dtype, backend and property, in order of first appearance."""
    groups: dict[tuple[str, str, str, str], list[Check]] = {}
    for check in checks:
        groups.setdefault((check.subject, check.dtype, check.backend, check.what), []).append(check)
    return [
        Summary(
            *key,
            checks=len(group),
            worst=max(group, key=lambda check: (not check.passed, _fraction_of_bound(check))),
            condition=max(check.condition for check in group),
            failed=tuple(check for check in group if not check.passed),
        )
        for key, group in groups.items()
    ]


def parse_dtypes(names: Sequence[str]) -> tuple[torch.dtype, ...]:
    """Dtypes by name.

    Raises:
        InputError: a name is not one of float32, bfloat16, float16.
    """
    known = {name_of(dtype): dtype for dtype in DTYPES}
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        raise InputError(f"dtypes: expected some of {', '.join(known)}, found {', '.join(unknown) or 'none'}")
    return tuple(known[name] for name in names)


def name_of(dtype: torch.dtype) -> str:
    """Name of a dtype, such as ``"float32"`` for ``torch.float32``."""
    return str(dtype).removeprefix("torch.")


def _fraction_of_bound(check: Check) -> float:
    fraction = check.error / check.allowed if check.allowed else 0.0
    return math.inf if math.isnan(fraction) else fraction
