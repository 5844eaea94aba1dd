"""Verification: test cases and equations of every operator, gradient checks, numerical stability, and an overview.

``gradcheck(function, *inputs)`` and ``check_stability(function, *inputs)`` check a user's own function.
"""

from mcdenoise.check.gradients import GradcheckResult, gradcheck
from mcdenoise.check.stability import Check, check_stability

__all__ = ["Check", "GradcheckResult", "check_stability", "gradcheck"]
