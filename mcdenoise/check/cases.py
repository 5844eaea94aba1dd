"""The table of ops with their test cases, for gradient checks, stability checks, benchmarks and tests.

To add an op, write its arguments and its rows on one of the pages that this one imports; the regimes of
:mod:`mcdenoise.check.regimes` come by themselves. Formulas of :data:`STEPS` are in ``tests/oracles/steps.py``.

Inputs avoid points without a derivative, where finite differences are meaningless: albedo near ``floor``, motion of
whole pixels, brightness near the limit of fireflies, the history length at which ``alpha`` reaches ``alpha_min``,
surfaces near the limits of the consistency test, kernel sums near zero. Cases that contain such points on purpose do
not list the inputs concerned as ``differentiable``.
"""

from __future__ import annotations

from mcdenoise.check import _pixels, _spatial, _temporal
from mcdenoise.check.case import Case, Inputs, Kind, Op, map_tensors

__all__ = ["OPS", "STEPS", "Case", "Inputs", "Kind", "Op", "map_tensors"]

OPS: tuple[Op, ...] = (*_spatial.OPS, *_pixels.OPS, *_temporal.OPS)
# Fused steps, which are not public.
STEPS: tuple[Op, ...] = _temporal.STEPS
