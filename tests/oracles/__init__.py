"""The equations of all ops as loops over pixels and taps, in Python's float64 numbers.

These functions are slow, and written to be compared with the formulas by eye. They share no code with the ops, so that
both cannot have the same error. They take the arguments of the ops; their results are always float64.
"""

from collections.abc import Callable
from typing import Any

from oracles import edges, filters, history, regression, resolutions, steps

PAGES = (filters, resolutions, edges, regression, history, steps)


def oracle(name: str) -> Callable[..., Any]:
    """The equation of the op, or of the fused step, of this name."""
    found: Callable[..., Any] = next(getattr(page, name) for page in PAGES if hasattr(page, name))
    return found
