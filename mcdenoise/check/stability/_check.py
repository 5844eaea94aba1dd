"""Results of stability checks."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

LONG_RUNS = "long runs"


@dataclass(frozen=True)
class Check:
    """Result of one check.

    Args:
        subject: the op, the model, the denoiser, or :data:`LONG_RUNS`.
        case: name of the inputs.
        dtype: such as ``"float32"``.
        backend: backend of an op; ``""`` if it has only one.
        what: the property that was checked, such as ``"forward"`` or ``"exposure"``.
        error: the error closest to its bound, in units of the dtype's epsilon times the condition number; of a long run
            relative to the largest value.
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

    @property
    def closeness(self) -> float:
        """The error as a fraction of its bound, infinite for NaN."""
        fraction = self.error / self.allowed if self.allowed else 0.0
        return math.inf if math.isnan(fraction) else fraction


def bounded(
    subject: str,
    case: str,
    dtype: torch.dtype,
    what: str,
    error: float = 0.0,
    allowed: float = 0.0,
    condition: float = 0.0,
    message: str = "",
    backend: str = "",
) -> Check:
    """A check that there is no message, and that an error is at most what is allowed; NaN is not."""
    if not message and not error <= allowed:
        message = f"error {error:.3g}, expected at most {allowed:.3g}"
    name = str(dtype).removeprefix("torch.")
    return Check(subject, case, name, backend, what, error, allowed, condition, not message, message)
