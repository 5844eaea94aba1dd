"""What a check of numerical stability finds, and the dtypes it is made in."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch

from mcdenoise.errors import InputError

DTYPES = (torch.float32, torch.bfloat16, torch.float16)


@dataclass(frozen=True)
class Check:
    """One thing that must hold, and what was found.

    Args:
        subject: the op, the model, or what else was tried.
        case: on what.
        dtype: ``"float32"`` and so on.
        backend: of an op; ``""`` where there is no choice.
        what: such as ``"forward"`` or ``"constant"``.
        error: largest error found, in units of the dtype's epsilon times the case's condition number.
        allowed: what the analysis allows there, in the same units.
        condition: largest condition number of the case: how much a relative change of the inputs is magnified.
        passed: whether it holds.
        message: what is wrong; empty if nothing is.
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
        checks: how many there are.
        worst: the one nearest to its bound, or beyond.
        condition: largest condition number of all.
        failed: those that do not hold.
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
    """Gather checks by subject, dtype, backend and kind, in the order in which these appear first."""
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
        InputError: a name is none of float32, bfloat16, float16.
    """
    known = {name_of(dtype): dtype for dtype in DTYPES}
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        raise InputError(f"dtypes: expected some of {', '.join(known)}, found {', '.join(unknown) or 'none'}")
    return tuple(known[name] for name in names)


def name_of(dtype: torch.dtype) -> str:
    """``"float32"`` of ``torch.float32``."""
    return str(dtype).removeprefix("torch.")


def _share(check: Check) -> float:
    share = check.error / check.allowed if check.allowed else 0.0
    return math.inf if math.isnan(share) else share
