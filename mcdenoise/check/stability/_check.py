"""The result of a check of numerical stability, and the checked dtypes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch

from mcdenoise.errors import InputError

DTYPES = (torch.float32, torch.bfloat16, torch.float16)


@dataclass(frozen=True)
class Check:
    """A property that must hold, and the measured error.

    Args:
        subject: the operator, model, or other subject.
        case: name of the test case.
        dtype: ``"float32"`` and so on.
        backend: backend of an operator; ``""`` if there is no choice.
        what: kind of check, such as ``"forward"`` or ``"constant"``.
        error: largest error, in units of the dtype's epsilon times the case's condition number.
        allowed: bound of the error by analysis, in the same units.
        condition: largest condition number of the case: amplification of a relative change of the inputs.
        passed: whether the property holds.
        message: description of the error; empty if there is none.
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
    """The checks of one kind for one subject and dtype, worst first.

    Args:
        subject: see :class:`Check`.
        dtype: see :class:`Check`.
        backend: see :class:`Check`.
        what: see :class:`Check`.
        checks: number of checks.
        worst: the check closest to its bound, or farthest above it.
        condition: largest condition number.
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
    """Group checks by subject, dtype, backend and kind, in order of first appearance."""
    groups: dict[tuple[str, str, str, str], list[Check]] = {}
    for check in checks:
        groups.setdefault((check.subject, check.dtype, check.backend, check.what), []).append(check)
    return [
        Summary(
            *key,
            checks=len(group),
            worst=max(group, key=lambda check: (not check.passed, _share(check))),
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
    """The name of a dtype, such as ``"float32"``."""
    return str(dtype).removeprefix("torch.")


def _share(check: Check) -> float:
    share = check.error / check.allowed if check.allowed else 0.0
    return math.inf if math.isnan(share) else share
