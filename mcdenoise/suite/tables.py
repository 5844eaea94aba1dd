"""The tables of the suite: each model against OIDN's best setting for each row, and error over samples."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

from mcdenoise.evaluate import METRICS
from mcdenoise.results import Cell, Method, Results
from mcdenoise.suite.rows import Row

SMAPE, PSNR, TEMPORAL = "SMAPE", "PSNR 2.2", "tRMSE"
SHOWN = (SMAPE, PSNR, TEMPORAL)
# With noisy features, OIDN's high quality uses its balanced network.
PEERS = (
    "oidn(quality=fast|balanced, auxiliary=clean|noisy, source=raw|accumulated),"
    "oidn(quality=high, auxiliary=clean, source=raw|accumulated)"
)
_PEER = "oidn"
# If a reference itself has this fraction of an error, the row is not conclusive.
_NOISY = 0.5


@dataclass(frozen=True)
class Best:
    """The peer's best value in a metric, with its setting.

    Args:
        value: value of the metric.
        setting: name of the method.
        milliseconds: run time per frame of that setting, if it was timed.
    """

    value: float
    setting: str
    milliseconds: float | None


@dataclass(frozen=True)
class Line:
    """The values of one model on one row.

    Args:
        row: name of the row.
        model: name of the method.
        samples: samples per pixel.
        values: the model's values by metric: SMAPE, PSNR of values clamped to [0, 1] on a power curve of 1/2.2, and for
            several frames the root mean squared error of differences between frames.
        best: the peer's values by metric, each with the setting that is best in it on this row; empty without the peer.
        noisy: values of the input.
        milliseconds: run time per frame, if it was timed.
        reference_noise: estimated SMAPE of the references.
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


def suite_lines(results: Results, rows: Iterable[Row]) -> list[Line]:
    """One line for each model and row of the table, by model; none where a model failed."""
    return _lines(results, [row for row in rows if not row.shot.curve])


def error_lines(results: Results, rows: Iterable[Row]) -> list[Line]:
    """Like :func:`suite_lines`, for the points of the curves of error over samples."""
    return _lines(results, [row for row in rows if row.shot.curve])


def _lines(results: Results, rows: list[Row]) -> list[Line]:
    ours = [method for method in results.methods if method.kind != "baseline" and method.model != _PEER]
    peers = [method for method in results.methods if method.model == _PEER]
    noise = {scene.name: scene.reference_noise for scene in results.scenes}
    lines = []
    for method in ours:
        for row in rows:
            cell = _cell(results, row, method.name)
            if cell is None:
                continue
            noisy = _cell(results, row, "noisy")
            lines.append(
                Line(
                    row.name,
                    method.name,
                    row.shot.samples,
                    _shown(cell),
                    _best(results, row, peers),
                    _shown(noisy) if noisy is not None else {},
                    _milliseconds(cell),
                    noise[row.name],
                )
            )
    return lines


def _cell(results: Results, row: Row, method: str) -> Cell | None:
    cell = results.cell(row.name, method)
    return None if cell is None or cell.failure else cell


def _shown(cell: Cell) -> dict[str, float]:
    return {name: cell.errors[name] for name in SHOWN if name in cell.errors}


def _milliseconds(cell: Cell) -> float | None:
    return None if cell.computing is None else cell.computing.median


def _best(results: Results, row: Row, peers: list[Method]) -> dict[str, Best]:
    found: dict[str, Best] = {}
    for method in peers:
        cell = _cell(results, row, method.name)
        for name, value in ({} if cell is None else _shown(cell)).items():
            if cell is not None and (name not in found or METRICS[name].better(value, found[name].value)):
                found[name] = Best(value, method.name, _milliseconds(cell))
    return found


def markdown(lines: list[Line], curves: list[Line]) -> str:
    """The tables in Markdown: one for each model with its wins and losses, and one of error over samples."""
    parts = []
    for model in dict.fromkeys(line.model for line in lines):
        own = [line for line in lines if line.model == model]
        parts += [f"## {model}", "", *_table(own), "", *(f"- {each}" for each in verdict(own)), ""]
    if curves:
        parts += ["## Error over samples", "", *_curve_table(curves), ""]
    return "\n".join(parts)


def sample_curves(curves: list[Line]) -> dict[str, dict[str, list[tuple[int, float]]]]:
    """SMAPE by number of samples, by scene (a row's name without samples) and model, ``input`` and ``OIDN, best``."""
    found: dict[str, dict[str, list[tuple[int, float]]]] = {}
    for line in curves:
        own = found.setdefault(line.row.rpartition("-")[0], {})
        points = {line.model: line.values, "input": line.noisy}
        points["OIDN, best"] = {name: best.value for name, best in line.best.items()}
        for name, values in points.items():
            point = (line.samples, values[SMAPE]) if SMAPE in values else None
            if point is not None and point not in own.setdefault(name, []):
                own[name].append(point)
    return {scene: {name: sorted(points) for name, points in own.items() if points} for scene, own in found.items()}


def verdict(lines: list[Line]) -> list[str]:
    """Comparison of one model with the peer: rows ahead and behind, and the mean ratio of SMAPE."""
    judged = [line for line in lines if line.best]
    if not judged:
        return ["OIDN was not there to compare with; pip install 'mcdenoise[peers]'"]
    said = []
    for metric in SHOWN:
        both = [line for line in judged if metric in line.values and metric in line.best]
        behind = [line.row for line in both if not line.ahead(metric)]
        if both:
            text = f"{metric}: ahead of OIDN's best setting in {len(both) - len(behind)} of {len(both)} rows"
            said.append(text + (f"; behind in {'; '.join(behind)}" if behind else ""))
    ratios = [line.values[SMAPE] / line.best[SMAPE].value for line in judged]
    mean = math.exp(sum(map(math.log, ratios)) / len(ratios))
    said.append(f"SMAPE over that of OIDN's best setting, geometric mean of {len(ratios)} rows: {mean:.3f}")
    unclear = [
        line.row for line in judged if line.reference_noise and line.reference_noise > _NOISY * line.best[SMAPE].value
    ]
    if unclear:
        said.append(f"references with more than half of the error themselves: {'; '.join(unclear)}")
    return said


def _table(lines: list[Line]) -> list[str]:
    heads = [
        "row",
        "SMAPE",
        "OIDN",
        "ratio",
        "PSNR",
        "OIDN",
        "tRMSE",
        "OIDN",
        "ms",
        "OIDN",
        "OIDN's setting",
        "reference",
    ]
    return _rows(heads, ([line.row, *_figures(line)] for line in lines))


def _figures(line: Line) -> list[str]:
    best = line.best
    smape = best.get(SMAPE)
    return [
        _number(line.values.get(SMAPE), ".4f"),
        _number(smape.value if smape else None, ".4f"),
        _number(line.values[SMAPE] / smape.value if smape else None, ".3f"),
        _number(line.values.get(PSNR), ".2f"),
        _number(best[PSNR].value if PSNR in best else None, ".2f"),
        _number(line.values.get(TEMPORAL), ".4f"),
        _number(best[TEMPORAL].value if TEMPORAL in best else None, ".4f"),
        _number(line.milliseconds, ".0f"),
        _number(smape.milliseconds if smape else None, ".0f"),
        smape.setting.removeprefix(_PEER) if smape else "",
        _number(line.reference_noise, ".4f"),
    ]


def _curve_table(curves: list[Line]) -> list[str]:
    models = list(dict.fromkeys(line.model for line in curves))
    by_row = {(line.row, line.model): line for line in curves}
    heads = ["row", *(f"{what}, {metric}" for metric in ("SMAPE", "PSNR") for what in ("input", *models, "OIDN"))]
    heads.append("reference")
    rows = []
    for row in dict.fromkeys(line.row for line in curves):
        any_line = next(line for line in curves if line.row == row)
        cells = [row]
        for metric, form in ((SMAPE, ".4f"), (PSNR, ".2f")):
            cells.append(_number(any_line.noisy.get(metric), form))
            for model in models:
                line = by_row.get((row, model))
                cells.append(_number(line.values.get(metric) if line else None, form))
            cells.append(_number(any_line.best[metric].value if metric in any_line.best else None, form))
        rows.append([*cells, _number(any_line.reference_noise, ".4f")])
    return _rows(heads, rows)


def _rows(heads: list[str], rows: Iterable[list[str]]) -> list[str]:
    lines = [heads, ["---"] * len(heads), *rows]
    return [f"| {' | '.join(cells)} |" for cells in lines]


def _number(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)
