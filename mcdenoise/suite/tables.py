"""The suite's tables: each model against OIDN's best setting on each row, and error over samples."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from statistics import geometric_mean

from mcdenoise.evaluate import METRICS
from mcdenoise.methods import split_methods
from mcdenoise.results import Cell, Results
from mcdenoise.suite.rows import Row

SMAPE, PSNR, TEMPORAL = "SMAPE", "PSNR 2.2", "tRMSE"
SHOWN = (SMAPE, PSNR, TEMPORAL)
# With noisy features, OIDN uses the same network for high and balanced quality.
_PEERS = (
    "oidn(quality=fast|balanced, auxiliary=clean|noisy, source=raw|accumulated),"
    "oidn(quality=high, auxiliary=clean, source=raw|accumulated),"
    "oidn(quality=high, auxiliary=prefiltered)"
)
_PEER = "oidn"
# If the reference's own noise is more than this fraction of an error, the row is marked as inconclusive.
_NOISY = 0.5


def with_peers(models: str) -> str:
    """These methods, and all settings of OIDN unless some are among them."""
    named = any(spelt.partition("(")[0].strip() == _PEER for spelt in split_methods(models))
    return models if named else f"{models},{_PEERS}"


@dataclass(frozen=True)
class Best:
    """The best value of the peer in one metric.

    Args:
        value: of the metric.
        setting: name of the method that reaches it.
        milliseconds: run time of that method; ``None`` if it was not timed.
    """

    value: float
    setting: str
    milliseconds: float | None


@dataclass(frozen=True)
class Line:
    """One model on one row.

    Args:
        row: name of the row.
        model: name of the method.
        samples: samples per pixel.
        values: the model's values by metric: SMAPE; PSNR of values clamped to [0, 1] on a power curve of 1/2.2; and for
            sequences the root mean squared error of differences between frames.
        best: the peer's best value by metric, over its settings on this row; empty without the peer.
        noisy: values of the input, by metric.
        milliseconds: run time per frame; ``None`` if it was not timed.
        reference_noise: estimated SMAPE of the references themselves.
    """

    row: str
    model: str
    samples: int
    values: dict[str, float]
    best: dict[str, Best] = field(default_factory=dict)
    noisy: dict[str, float] = field(default_factory=dict)
    milliseconds: float | None = None
    reference_noise: float | None = None

    def ahead(self, metric: str) -> bool:
        """Whether the model is better than the peer's best setting."""
        return METRICS[metric].better(self.values[metric], self.best[metric].value)


def lines_of(results: Results, rows: Iterable[Row], *, curve: bool = False) -> list[Line]:
    """The lines of the table, or of the curves of error over samples, model by model; none where a model failed."""
    own = [row for row in rows if row.shot.curve is curve]
    ours = [method for method in results.methods if method.kind != "baseline" and method.model != _PEER]
    noise = {scene.name: scene.reference_noise for scene in results.scenes}
    return [
        Line(
            row.name,
            method.name,
            row.shot.samples,
            _shown(cell),
            _best(results, row),
            _shown(_cell(results, row, "noisy")),
            _milliseconds(cell),
            noise[row.name],
        )
        for method in ours
        for row in own
        if (cell := _cell(results, row, method.name)) is not None
    ]


def _cell(results: Results, row: Row, method: str) -> Cell | None:
    cell = results.cell(row.name, method)
    return None if cell is None or cell.failure else cell


def _shown(cell: Cell | None) -> dict[str, float]:
    return {} if cell is None else {name: cell.errors[name] for name in SHOWN if name in cell.errors}


def _milliseconds(cell: Cell) -> float | None:
    return None if cell.computing is None else cell.computing.median


def _best(results: Results, row: Row) -> dict[str, Best]:
    found: dict[str, Best] = {}
    for method in results.methods:
        cell = _cell(results, row, method.name) if method.model == _PEER else None
        for name, value in _shown(cell).items():
            if cell is not None and (name not in found or METRICS[name].better(value, found[name].value)):
                found[name] = Best(value, method.name, _milliseconds(cell))
    return found


@dataclass(frozen=True)
class MethodMean:
    """Mean error and mean run time of a method over rows.

    Args:
        method: its name.
        error: geometric mean of its SMAPE relative to that of the noisy input.
        milliseconds: geometric mean of its run times per frame.
        beaten_by: a method that is neither slower nor worse; empty for methods on the Pareto front.
    """

    method: str
    error: float
    milliseconds: float
    beaten_by: str = ""


def error_against_time(results: Results, rows: Iterable[Row]) -> tuple[list[MethodMean], int]:
    """Mean error and run time of each method over the rows of the table, fastest first, and the number of these rows.

    Methods without any result are skipped. Only rows on which all other methods have an error and a run time count.
    """
    names = [
        method.name
        for method in results.methods
        if method.kind != "baseline" and any(cell.method == method.name and not cell.failure for cell in results.cells)
    ]
    points: list[dict[str, tuple[float, float]]] = []
    for row in rows:
        found = {name: point for name in names if (point := _point(results, row, name)) is not None}
        if not row.shot.curve and len(found) == len(names):
            points.append(found)
    means: list[MethodMean] = []
    for name in names if points else ():
        errors, times = zip(*(point[name] for point in points), strict=True)
        means.append(MethodMean(name, geometric_mean(errors), geometric_mean(times)))
    means.sort(key=lambda mean: (mean.milliseconds, mean.error))
    for i, mean in enumerate(means):
        best = min(means[:i], key=lambda other: other.error, default=mean)
        if best.error <= mean.error and best is not mean:
            means[i] = replace(mean, beaten_by=best.method)
    return means, len(points)


def _point(results: Results, row: Row, method: str) -> tuple[float, float] | None:
    """Error relative to that of the noisy input, and milliseconds."""
    noisy, cell = _cell(results, row, "noisy"), _cell(results, row, method)
    if noisy is None or cell is None or cell.computing is None:
        return None
    if SMAPE not in cell.errors or not noisy.errors.get(SMAPE):
        return None
    return cell.errors[SMAPE] / noisy.errors[SMAPE], cell.computing.median


def markdown(lines: list[Line], curves: list[Line], means: Sequence[MethodMean] = (), counted: int = 0) -> str:
    """The tables in Markdown: error against time, one table per model with its wins and losses, error over samples.

    Args:
        lines: see :func:`lines_of`.
        curves: see :func:`lines_of`.
        means: see :func:`error_against_time`.
        counted: number of rows behind ``means``.
    """
    parts = []
    if means:
        about = (
            f"SMAPE relative to that of the noisy input, and milliseconds per frame: geometric means over {counted} "
            "rows."
        )
        parts += ["## Error against time", "", about, "", *_means_table(means), ""]
    for model in dict.fromkeys(line.model for line in lines):
        own = [line for line in lines if line.model == model]
        parts += [f"## {model}", "", *_table(own), "", *(f"- {each}" for each in verdict(own)), ""]
    if curves:
        parts += ["## Error over samples", "", *_curve_table(curves), ""]
    return "\n".join(parts)


def sample_curves(curves: list[Line]) -> dict[str, dict[str, list[tuple[int, float]]]]:
    """SMAPE over samples, by scene (a row's name without its samples) and by model, ``input`` or ``OIDN, best``."""
    found: dict[str, dict[str, list[tuple[int, float]]]] = {}
    for line in curves:
        own = found.setdefault(line.row.rpartition("-")[0], {})
        for name, values in {line.model: line.values, "input": line.noisy, "OIDN, best": _of_best(line)}.items():
            point = (line.samples, values[SMAPE]) if SMAPE in values else None
            if point is not None and point not in own.setdefault(name, []):
                own[name].append(point)
    return {scene: {name: sorted(points) for name, points in own.items() if points} for scene, own in found.items()}


def verdict(lines: list[Line]) -> list[str]:
    """Summary of one model against the peer: the rows where it is ahead and behind, and the mean ratio of SMAPE."""
    judged = [line for line in lines if line.best]
    if not judged:
        return ["OIDN is not installed, so there is no comparison with it; pip install 'mcdenoise[peers]'"]
    summary = []
    for metric in SHOWN:
        both = [line for line in judged if metric in line.values and metric in line.best]
        behind = [line.row for line in both if not line.ahead(metric)]
        if both:
            text = f"{metric}: ahead of OIDN's best setting in {len(both) - len(behind)} of {len(both)} rows"
            summary.append(text + (f"; behind in {'; '.join(behind)}" if behind else ""))
    ratios = [line.values[SMAPE] / line.best[SMAPE].value for line in judged]
    mean = geometric_mean(ratios)
    summary.append(f"SMAPE relative to OIDN's best setting, geometric mean over {len(ratios)} rows: {mean:.3f}")
    unclear = [
        line.row for line in judged if line.reference_noise and line.reference_noise > _NOISY * line.best[SMAPE].value
    ]
    if unclear:
        summary.append(f"rows whose reference noise is more than half of the error: {'; '.join(unclear)}")
    return summary


def _table(lines: list[Line]) -> list[str]:
    columns = ((SMAPE, ".4f"), (PSNR, ".2f"), (TEMPORAL, ".4f"))
    heads = ["row", "SMAPE", "OIDN", "ratio", "PSNR", "OIDN", "tRMSE", "OIDN", "ms", "OIDN"]
    rows = []
    for line in lines:
        cells = [_number(values.get(name), form) for name, form in columns for values in (line.values, _of_best(line))]
        smape = line.best.get(SMAPE)
        cells.insert(2, _number(line.values[SMAPE] / smape.value if smape else None, ".3f"))
        cells += [_number(line.milliseconds, ".0f"), _number(smape.milliseconds if smape else None, ".0f")]
        cells += [smape.setting.removeprefix(_PEER) if smape else "", _number(line.reference_noise, ".4f")]
        rows.append([line.row, *cells])
    return _rows([*heads, "OIDN's setting", "reference"], rows)


def _of_best(line: Line) -> dict[str, float]:
    return {name: best.value for name, best in line.best.items()}


def _means_table(means: Sequence[MethodMean]) -> list[str]:
    def row(mean: MethodMean) -> list[str]:
        front = f"no: {mean.beaten_by}" if mean.beaten_by else "yes"
        return [mean.method, _number(mean.error, ".4f"), _number(mean.milliseconds, ".0f"), front]

    return _rows(["method", "SMAPE", "ms", "on the Pareto front"], map(row, means))


def _curve_table(curves: list[Line]) -> list[str]:
    models = list(dict.fromkeys(line.model for line in curves))
    heads = ["row", *(f"{what}, {metric}" for metric in ("SMAPE", "PSNR") for what in ("input", *models, "OIDN"))]
    rows = []
    for row in dict.fromkeys(line.row for line in curves):
        own = {line.model: line for line in curves if line.row == row}
        any_line = next(iter(own.values()))
        shown = [any_line.noisy, *(own[name].values if name in own else {} for name in models), _of_best(any_line)]
        cells = [_number(values.get(name), form) for name, form in ((SMAPE, ".4f"), (PSNR, ".2f")) for values in shown]
        rows.append([row, *cells, _number(any_line.reference_noise, ".4f")])
    return _rows([*heads, "reference"], rows)


def _rows(heads: list[str], rows: Iterable[list[str]]) -> list[str]:
    lines = [heads, ["---"] * len(heads), *rows]
    return [f"| {' | '.join(cells)} |" for cells in lines]


def _number(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)
