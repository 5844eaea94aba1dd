"""The proof, outside the shop window: cases and equations of every op, gradient checks, stability, and the overview.

``gradcheck(function, *inputs)`` and ``check_stability(function, *inputs)`` prove a function of one's own.
"""

from mcdenoise.check.gradients import GradcheckResult, gradcheck
from mcdenoise.check.stability import Check, check_stability

__all__ = ["Check", "GradcheckResult", "check_stability", "gradcheck"]
