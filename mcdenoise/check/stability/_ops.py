"""Errors of ops and their gradients, against bounds from rounding error analysis.

An op is compared with itself in float64. There it is compared with its equation, written as loops, by tests, and its
gradients with finite differences, by :mod:`mcdenoise.check.gradients`.

The bound of a result ``y = f(x)`` is as follows. Let ``u`` be the unit roundoff of the dtype in which an op computes
(float32 for half precision), and ``v`` that of the dtype of the result. A backward stable op returns the exact result
of inputs that differ by at most ``n u`` times their magnitude ``s``, and rounds it:

    ``|error| <= v |y| + n u (|y| + sum_j s_j |dy / dx_j|)``

The sum is the (absolute, componentwise) condition number: the change of the exact result with that of the inputs. It is
not computed from derivatives but measured in float64, by perturbing every input up and down by ``16 u``, so that it
includes kinks and jumps within the reach of rounding. ``s_j`` is ``|x_j|``, at least the smallest normal number (below
it there are fewer digits), and more for ops with larger intermediate values, see ``rounds`` of
:class:`mcdenoise.check.case.Op`.

``n`` is the number of rounding errors. A sum of ``m`` terms has ``m - 1``, and a result that depends on ``m`` inputs
consists of sums of at most ``m`` terms; products, quotients and exponentials add at most 8. So ``n = m + 8``.

The terms of a gradient may cancel, although no input is ill-conditioned. So a gradient may differ from that in float64
by as much as 4 times the rounding of every step of its computation changes it, see :mod:`._rounding`. There ``u`` is
that of the dtype itself, because half-precision values are rounded when an op passes them to autograd.

A user's function may have intermediate values of any dtype: ``u`` is that of the dtype itself for its results too. It
may combine the images of a batch: perturbed inputs are computed one by one. And its gradients must be as exact as its
results: their bound is that of a function of the inputs and of the upstream gradient.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from mcdenoise.check import gradients
from mcdenoise.check.case import DTYPES, Case, Op, map_tensors, tensors_in
from mcdenoise.check.own import op_of
from mcdenoise.check.stability._check import Check, bounded
from mcdenoise.check.stability._rounding import spread
from mcdenoise.check.stability._trial import Function, Trial, backends
from mcdenoise.errors import in_one_line
from mcdenoise.ops._window import accumulator_dtype

_DEPTH = 8
_PROBE = 16
_AT_ONCE = 256  # perturbed inputs in one batch
_DRAWS, _ALLOWED = 32, 4
_NOISE = 1e-12  # relative noise of float64: a vectorised exponential rounds its last elements differently
# Scaling by powers of two does not round, so results must scale exactly: 1.2e-4 and 8.2e3.
_EXPOSURES = (2.0**-13, 2.0**13)


@dataclass(frozen=True)
class _Exact:
    """One result in float64, with its condition number and the bound of its error."""

    value: Tensor
    condition: Tensor
    bound: Tensor


def check_op(op: Op, dtypes: Sequence[torch.dtype] = DTYPES) -> Iterator[Check]:
    """Check an op case by case, in each dtype and on each available backend.

    Args:
        op: an op of the table.
        dtypes: the dtypes to check.
    """
    # First derivatives in float64 are the reference for those in other dtypes.
    for case in (case for case in op.cases if op.own and case.differentiable):
        result = gradients.check_case(op, case, order=1)
        yield bounded(op.name, case.name, torch.float64, "derivative", message=result.message)
    for dtype in dtypes:
        if not op.half_precision and accumulator_dtype(dtype) != dtype:
            continue
        for case in op.cases:
            yield from check_case(op, case, dtype)


def check_stability(
    function: Callable[..., Any], *inputs: Tensor, dtypes: Sequence[torch.dtype] = DTYPES
) -> list[Check]:
    """Compare a function of your own, and its gradients, with itself in float64, against bounds from error analysis.

    ``mcdenoise stability path/to/file.py:function`` does the same.

    Args:
        function: takes floating-point tensors, and returns one or several.
        inputs: small example inputs; by default those of the function, see :mod:`mcdenoise.check.own`.
        dtypes: the dtypes to check.

    Raises:
        InputError: ``function`` is not such a function, or it runs on none of its example inputs.

    Example:
        >>> import torch
        >>> from mcdenoise.check import check_stability
        >>> all(check.passed for check in check_stability(torch.sin, torch.rand(1, 3, 2, 2)))
        True
    """
    return list(check_op(op_of(function, inputs), dtypes))


def check_case(op: Op, case: Case, dtype: torch.dtype) -> Iterator[Check]:
    """Check an op on one case: each property that applies, on each backend; ``"runs"`` for one that cannot run here.

    Args:
        op: an op of the table.
        case: one of its cases.
        dtype: dtype of the inputs.
    """
    # Exact results take most of the time, and are the same for every backend.
    exact: dict[str, list[_Exact]] = {}
    for backend in backends(op):
        yield from _checks(Trial(op, case, dtype, backend, case.inputs(dtype)), exact)


def _checks(trial: Trial, known: dict[str, list[_Exact]]) -> Iterator[Check]:
    try:
        results = trial.run(trial.leaves)
    except Exception as error:
        yield replace(trial.found("runs", message=in_one_line(error)), passed=_cannot_run(trial, error))
        return
    exact = known["forward"] = known.get("forward") or _exact_results(trial, results)
    yield _compare(trial, "forward", results, exact)
    leaves = [*trial.leaves, *map(_upstream, results)]
    try:
        gradients = trial.gradients(leaves)
    except Exception as error:
        if not _cannot_run(trial, error):
            yield trial.found("gradient", message=in_one_line(error))
    else:
        true = known["gradient"] = known.get("gradient") or _exact_gradients(trial, leaves, exact)
        yield _compare(trial, "gradient", gradients, true)
    if trial.op.weights(trial.case.settings):
        yield _check_weights(trial, results[0])
    if trial.op.images and trial.case.kind != "extreme":
        yield _check_exposure(trial, results[0])


def _cannot_run(trial: Trial, error: Exception) -> bool:
    """Whether that is the error of a backend that is not on this machine, or has no derivatives."""
    return bool(trial.backend) and isinstance(error, ValueError) and "can run here" in str(error)


def _exact_results(trial: Trial, results: list[Tensor]) -> list[_Exact]:
    """The op's results in float64, with their error bounds."""
    inputs = map_tensors(Tensor.double, trial.inputs)
    rounded = trial.op.rounds(inputs, trial.case.settings)
    lost = rounded.get("result", 0.0)
    leaves, tiny = [leaf.double() for leaf in trial.leaves], torch.finfo(trial.inner).tiny
    values = {name: value for name, value in inputs.items() if name in trial.numbers}
    values |= {name: value for name, value in rounded.items() if name in values}
    magnitudes = tensors_in(map_tensors(lambda tensor: tensor.abs() + tiny, values))
    conditions = _conditions(trial.run, leaves, magnitudes, trial.inner, at_once=not trial.op.own)
    return [
        _bounded(value, condition + lost, fan_in, trial.inner, result.dtype)
        for value, result, (condition, fan_in) in zip(trial.run(leaves), results, conditions, strict=True)
    ]


def _exact_gradients(trial: Trial, leaves: list[Tensor], results: list[_Exact]) -> list[_Exact]:
    """The gradients of the op in float64, which gradcheck compares with finite differences, with their error bounds."""
    exact = [leaf.double() for leaf in leaves]
    if trial.op.own:
        magnitudes = [leaf.abs() + torch.finfo(trial.dtype).tiny for leaf in exact]
        conditions = _conditions(trial.gradients, exact, magnitudes, trial.dtype, at_once=False)
    else:
        unit = _unit(trial.dtype)
        changes = spread(trial.gradients, exact, trial.dtype, _DRAWS, _ALLOWED)
        rounded = trial.op.rounds(map_tensors(Tensor.double, trial.inputs), trial.case.settings)
        terms = map_tensors(torch.zeros_like, trial.numbers)
        terms |= {name: rounded[key] for name in terms if (key := f"gradient of {name}") in rounded}
        largest = max((leaf.abs().max().item() for leaf in exact[len(trial.leaves) :] if leaf.numel()), default=0.0)
        conditions = [
            (change / unit / _DEPTH + largest * term, torch.zeros_like(change))
            for change, term in zip(changes, tensors_in(terms), strict=True)
        ]
    # If a result is rightly infinite, its derivative may be infinite or NaN; otherwise it must be finite. What must be
    # finite in any case stays as it is, so that it is reported.
    defined = not trial.must_be_finite and _all_finite([result.value for result in results])
    bounded = []
    for value, (condition, fan_in) in zip(trial.gradients(exact), conditions, strict=True):
        excused = ~value.isnan() | (not defined)
        condition = torch.where(excused, condition, 0)
        bounded.append(_bounded(torch.where(excused, value, 0), condition, fan_in, trial.dtype, trial.dtype))
    return bounded


def _conditions(
    function: Function, leaves: list[Tensor], magnitudes: list[Tensor], dtype: torch.dtype, *, at_once: bool
) -> list[tuple[Tensor, Tensor]]:
    """Measure ``sum_j s_j |dy / dx_j|`` of each result, and the number of inputs that it depends on.

    Ops treat the images of a batch identically and independently, so that one call computes many perturbed inputs, if
    ``at_once`` is set.
    """
    step = _PROBE * torch.finfo(dtype).eps / 2
    base = function(leaves)
    changing = function if at_once else _one_by_one(function, leaves)
    # Infinity is not perturbed, and zeros of non-negative inputs are not perturbed below zero.
    up = torch.cat([torch.where(size.isfinite(), step * size, 0).flatten() for size in magnitudes])
    below = torch.cat([((leaf != 0) | (leaf < 0).any()).flatten() for leaf in leaves])
    flat, sizes = torch.cat([leaf.flatten() for leaf in leaves]), [leaf.numel() for leaf in leaves]
    totals = [torch.zeros_like(result) for result in base]
    fans = [torch.zeros_like(result) for result in base]
    for numbers in torch.arange(len(flat)).split(_AT_ONCE) if len(flat) else ():
        rows, count = torch.arange(len(numbers)), len(numbers)
        # Two copies of all inputs for each number of them.
        pairs = flat.repeat(count, 2, 1)
        pairs[rows, 0, numbers] += up[numbers]
        pairs[rows, 1, numbers] -= (up * below)[numbers]
        parts = pairs.flatten(0, 1).split(sizes, 1)
        copies = [part.reshape(-1, *leaf.shape[1:]) for part, leaf in zip(parts, leaves, strict=True)]
        for result, total, fan, changed in zip(base, totals, fans, changing(copies), strict=True):
            both = changed.reshape(count, 2, *result.shape)
            change = (both - result).abs()
            same = (both == result) | (both.isnan() & result.isnan()) | (change <= _NOISE * result.abs())
            larger = torch.where(same, 0, change.nan_to_num(nan=math.inf)).amax(1)
            total += larger.sum(0) / step
            fan += (larger > 0).sum(0)
    return list(zip(totals, fans, strict=True))


def _one_by_one(function: Function, leaves: list[Tensor]) -> Function:
    """A function of many copies of the inputs that calls ``function`` for each copy."""

    def run(copies: Sequence[Tensor]) -> list[Tensor]:
        count = copies[0].numel() // leaves[0].numel()
        stacked = [copy.reshape(count, *leaf.shape) for copy, leaf in zip(copies, leaves, strict=True)]
        return [torch.stack(each) for each in zip(*map(function, zip(*stacked, strict=True)), strict=True)]

    return run


def _bounded(value: Tensor, condition: Tensor, fan_in: Tensor, inner: torch.dtype, outer: torch.dtype) -> _Exact:
    size = torch.where(value.isfinite(), value.abs(), 0)
    condition = size + condition
    bound = _unit(outer) * size + torch.finfo(outer).tiny + (fan_in + _DEPTH) * _unit(inner) * condition
    return _Exact(value, condition, bound)


def _compare(trial: Trial, what: str, results: list[Tensor], exact: list[_Exact]) -> Check:
    """Compare results with exact ones; results beyond the range of the dtype must be infinite, all others finite."""
    values = [truth.value for truth in exact]
    # NaN would excuse any result, and so would infinity.
    undefined = any(value.isnan().any() for value in values)
    must_be_finite = trial.must_be_finite or (trial.op.finite and what != "gradient")
    if _all_finite(trial.leaves) and (undefined or (must_be_finite and not _all_finite(values))):
        kind = "NaN" if undefined else "infinity"
        return trial.found(what, message=f"{kind} in float64, where all inputs are finite")
    worst, highest, condition, message = (0.0, 0.0), 0.0, 0.0, ""
    for result, truth in zip(results, exact, strict=True):
        largest = torch.finfo(result.dtype).max
        # Partial sums may exceed the range even if the result does not.
        safe = truth.condition < torch.finfo(accumulator_dtype(result.dtype)).max / 2
        safe &= truth.value.abs() + truth.bound < largest
        found = result.double()
        error = (found - truth.value).abs()
        beyond = truth.value.isfinite() & ~safe
        error = torch.where(beyond | (found == truth.value), 0, error)
        error = torch.where(truth.value.isnan(), 0, error)
        error = torch.where(error.isnan(), math.inf, error)
        if found[beyond].isnan().any() and truth.condition[beyond].isfinite().all():
            message = message or "NaN where the result is too large for the dtype"
        fraction = torch.where(error == 0, 0, error / truth.bound)
        if not fraction.numel():
            continue
        magnification = torch.where(truth.value != 0, truth.condition / truth.value.abs(), 0)
        condition = max(
            condition, magnification[magnification.isfinite()].max().item() if magnification.isfinite().any() else 0
        )
        i = int(fraction.argmax())
        if fraction.reshape(-1)[i] >= highest:
            highest = fraction.reshape(-1)[i].item()
            unit = torch.finfo(result.dtype).eps * truth.condition.reshape(-1)[i].item()
            # Within the reach of rounding there may be a pole, beside which no figure is meaningful.
            known = 0 < unit < math.inf
            worst = (error.reshape(-1)[i].item() / unit, truth.bound.reshape(-1)[i].item() / unit) if known else (0, 0)
        if fraction.max() > 1 and not message:
            message = f"found {found.reshape(-1)[i].item():.9g}, expected {truth.value.reshape(-1)[i].item():.9g}"
    return trial.found(what, *worst, condition, message)


def _all_finite(tensors: Sequence[Tensor]) -> bool:
    return all(bool(tensor.isfinite().all()) for tensor in tensors)


def _check_weights(trial: Trial, weights: Tensor) -> Check:
    """Weights are non-negative and sum to one, up to one rounding error per weight and one per tap of the sum."""
    total = weights.double().sum(1)
    allowed = _unit(weights.dtype) + (weights.shape[1] + _DEPTH) * _unit(accumulator_dtype(weights.dtype))
    allowed += weights.shape[1] * torch.finfo(weights.dtype).tiny
    error = (total - 1).abs().max().item() if total.numel() else 0.0
    message = "" if bool((weights >= 0).all()) else "a weight is negative or NaN"
    eps = torch.finfo(weights.dtype).eps
    return trial.found("weights", error / eps, allowed / eps, 1.0, message)


def _check_exposure(trial: Trial, result: Tensor) -> Check:
    """``f(s x) = s f(x)``, exactly, as long as no value leaves the range of the dtype."""
    message = ""
    for exposure in _EXPOSURES:
        given: dict[str, Any] = trial.inputs
        images = {name: exposure * given[name] for name in trial.op.images if name in given}
        if not all(bool(_normal_range(image).all()) for image in images.values()):
            continue
        scaled = replace(trial, inputs={**trial.inputs, **images})
        found, expected = scaled.run(scaled.leaves)[0], result * exposure
        if not torch.equal(found, expected) and bool(_normal_range(expected).all()):
            message = f"the result of the image times {exposure:g} is not {exposure:g} times that of the image"
    return trial.found("exposure", condition=1.0, message=message)


def _normal_range(tensor: Tensor) -> Tensor:
    limits = torch.finfo(tensor.dtype)
    # Terms of a sum may be smaller than the sum.
    size = tensor.abs()
    return (size == 0) | ((size >= limits.tiny / limits.eps) & (size <= limits.max / 64))


def _upstream(result: Tensor) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.randn(result.shape, generator=generator, dtype=torch.float64).to(result.dtype)


def _unit(dtype: torch.dtype) -> float:
    return torch.finfo(dtype).eps / 2
