"""The rows of plots and tables: every method on one scene, or in the mean over the scenes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from statistics import fmean
from typing import NamedTuple, TypeVar

from mcdenoise.errors import InputError
from mcdenoise.evaluate import METRICS
from mcdenoise.results import STAGES, Method, Results, Spread

T = TypeVar("T")

FILE_STAGES = ("read", "write")


class Range(NamedTuple):
    """A mean or median with the quartiles of its values; the mean of skewed values may lie outside of them.

    Args:
        value: mean or median.
        lower: first quartile.
        upper: third quartile.
    """

    value: float
    lower: float
    upper: float


@dataclass(frozen=True)
class Row:
    """One method in a view.

    Args:
        method: which.
        number: its place among all methods, from 1; the same in every view.
        errors: by metric.
        milliseconds: a frame, without reading and writing files.
        whole: milliseconds a frame with files.
        stages: milliseconds of each stage that the method has, in the order of :data:`mcdenoise.results.STAGES`.
        throughput: megapixels a second, without files.
        memory: mebibytes.
        reason: why there are no figures, or ``""``.
    """

    method: Method
    number: int
    errors: dict[str, Range] = field(default_factory=dict)
    milliseconds: Range | None = None
    whole: Range | None = None
    stages: dict[str, Range] = field(default_factory=dict)
    throughput: float | None = None
    memory: float | None = None
    reason: str = ""


@dataclass(frozen=True)
class View:
    """Every method on one scene, or in the mean over the scenes.

    Args:
        name: of the scene, or ``mean of N scenes``.
        rows: in the order of the methods; those without figures too.
    """

    name: str
    rows: list[Row]


def views(results: Results) -> list[View]:
    """The mean over the scenes, where there are several, and each scene.

    In the mean every scene counts the same, and a method that failed on one of them has a reason and no figures.
    """
    scenes = [
        View(
            scene.name, [_row(results, number, method, scene.name) for number, method in enumerate(results.methods, 1)]
        )
        for scene in results.scenes
    ]
    if len(scenes) < 2:
        return scenes
    rows = [_mean(list(rows), results) for rows in zip(*(view.rows for view in scenes), strict=True)]
    return [View(f"mean of {len(scenes)} scenes", rows), *scenes]


def shortlist(results: Results, most: int) -> Results:
    """The results of the methods that a page shows, in the same order.

    They are all, if they are few enough. Otherwise these, up to the number: the baselines; the best setting of each
    model, the best model first; and the methods on the Pareto front of error and run time.

    Args:
        results: of a benchmark.
        most: number of methods.

    Raises:
        InputError: see :func:`metrics`.
    """
    if len(results.methods) <= most:
        return results
    view, metric = views(results)[0], next(iter(metrics(results)), "")
    ranked = sorted(view.rows, key=lambda row: rank(row, metric))
    best = {row.method.model: row for row in reversed(ranked)}
    baselines = [row for row in view.rows if row.method.kind == "baseline"]
    wanted = [*baselines, *(row for row in ranked if row in best.values()), *front(view, metric)]
    names = list(dict.fromkeys(row.method.name for row in wanted))[:most]
    return replace(
        results,
        methods=[method for method in results.methods if method.name in names],
        cells=[cell for cell in results.cells if cell.method in names],
        costs=[cost for cost in results.costs if cost.method in names],
        fits=[fit for fit in results.fits if fit.method in names],
    )


def metrics(results: Results) -> list[str]:
    """Names of the metrics that were computed, in the order of :data:`mcdenoise.evaluate.METRICS`.

    Raises:
        InputError: a metric that this version does not know.
    """
    found = {name for cell in results.cells for name in cell.errors}
    unknown = sorted(found - set(METRICS))
    if unknown:
        raise InputError(
            f"results: expected metrics out of {', '.join(METRICS)}, found {', '.join(unknown)}; "
            "use the version that measured them"
        )
    return [name for name in METRICS if name in found]


def points(view: View, metric: str) -> list[tuple[Row, Range, Range]]:
    """The methods that have both a time and an error, each with milliseconds and the error."""
    return [
        (row, row.milliseconds, row.errors[metric])
        for row in view.rows
        if row.milliseconds is not None and row.milliseconds.value > 0 and metric in row.errors
    ]


def front(view: View, metric: str) -> list[Row]:
    """The methods that no other beats in run time without being beaten in error, by rising run time.

    Of several with the same values it is the first.
    """
    found: list[Row] = []
    for row, *_ in sorted(points(view, metric), key=lambda point: (point[1].value, rank(point[0], metric))):
        if not found or rank(row, metric) < rank(found[-1], metric):
            found.append(row)
    return found


def rank(row: Row, metric: str) -> float:
    """A key to sort rows by, the best first, and last those without a value."""
    return METRICS[metric].rank(row.errors[metric].value) if metric in row.errors else math.inf


def _row(results: Results, number: int, method: Method, scene: str) -> Row:
    cell = results.cell(scene, method.name)
    if method.missing or cell is None or cell.failure:
        failed = cell.reason if cell and cell.failure else "not measured"
        return Row(method, number, reason=f"missing: {method.missing}" if method.missing else failed)
    milliseconds = None if cell.computing is None else _range(cell.computing)
    # A method that returns its input has no run time to show on a logarithmic axis.
    if milliseconds and not cell.stages.keys() - set(FILE_STAGES):
        milliseconds = Range(0.0, 0.0, 0.0)
    return Row(
        method,
        number,
        {
            name: _range(cell.errors_spread[name])._replace(value=x) if name in cell.errors_spread else Range(x, x, x)
            for name, x in cell.errors.items()
        },
        milliseconds,
        None if cell.whole is None else _range(cell.whole),
        {stage: _range(cell.stages[stage]) for stage in STAGES if stage in cell.stages},
        results.megapixels_per_second(cell) if milliseconds and milliseconds.value > 0 else None,
        cell.memory,
    )


def _range(spread: Spread) -> Range:
    return Range(spread.median, spread.lower, spread.upper)


def _mean(rows: list[Row], results: Results) -> Row:
    first = rows[0]
    reasons = [f"{scene.name}: {row.reason}" for scene, row in zip(results.scenes, rows, strict=True) if row.reason]
    if first.method.missing:
        return first
    if reasons:
        return Row(first.method, first.number, reason="; ".join(reasons))
    known = [name for name in first.errors if all(name in row.errors for row in rows)]
    stages = [stage for stage in STAGES if any(stage in row.stages for row in rows)]
    # A stage that a scene does without, such as one with no albedo to divide out, takes no time there.
    nothing = Range(0.0, 0.0, 0.0)
    return Row(
        first.method,
        first.number,
        {name: _mean_range([row.errors[name] for row in rows]) for name in known},
        _if_all(_mean_range, [row.milliseconds for row in rows]),
        _if_all(_mean_range, [row.whole for row in rows]),
        {stage: _mean_range([row.stages.get(stage, nothing) for row in rows]) for stage in stages},
        _if_all(fmean, [row.throughput for row in rows]),
        _if_all(fmean, [row.memory for row in rows]),
    )


def _mean_range(ranges: list[Range]) -> Range:
    return Range(*map(fmean, zip(*ranges, strict=True)))


def _if_all(mean: Callable[[list[T]], T], values: list[T | None]) -> T | None:
    """The mean, if no value is missing."""
    known = [value for value in values if value is not None]
    return mean(known) if len(known) == len(values) else None
