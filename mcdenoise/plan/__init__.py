"""Which stages a scene needs, decided from its data before and while a sequence runs, and why."""

from mcdenoise.plan.noise_free import noise_free
from mcdenoise.plan.stages import TOLERANCE, Plan, Shortcut, Stage, Steps, summarize

__all__ = ["TOLERANCE", "Plan", "Shortcut", "Stage", "Steps", "noise_free", "summarize"]
