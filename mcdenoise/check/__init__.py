"""Verification of the operators: test cases, equations in float64, gradient checks, stability checks, an overview.

``gradcheck(function, *inputs)`` and ``check_stability(function, *inputs)`` check a function of your own.
"""

from mcdenoise.check.gradients import GradcheckResult, gradcheck
from mcdenoise.check.stability import Check, check_stability

__all__ = ["Check", "GradcheckResult", "check_stability", "gradcheck"]
