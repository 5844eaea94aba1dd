"""The plots: error over time, stages, cost over pixels; for papers, and as text in a page that is dark or light."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from html import escape
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, MaxNLocator, NullLocator

from mcdenoise.data.files import atomic_path
from mcdenoise.errors import InputError
from mcdenoise.evaluate import METRICS
from mcdenoise.report.views import Row, View, front, points
from mcdenoise.results import STAGES, Method, Results

# Okabe and Ito 2008, told apart with every kind of colour blindness; behind them four more, for ten models.
_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f4fc9", "#8a4b20", "#6b8e00", "#c2185b")
_BASELINE = "#767676"
_STAGES = dict(zip(STAGES, ("#b5b5b5", "#56b4e9", "#0072b2", "#d55e00", "#8a8a8a"), strict=True))
_INK, _MUTED, _RULE, _PAPER = "#1c1c1e", "#6b6b70", "#e2e2e4", "#fefefe"
# In the page a colour is a variable of its style sheet, so that it follows the reader's light or dark.
_VARIABLES = {_INK: "ink", _MUTED: "muted", _RULE: "rule", _PAPER: "paper", _BASELINE: "baseline"}
_VARIABLES |= {color: f"hue-{index}" for index, color in enumerate(_COLORS)}
_VARIABLES |= {_STAGES["read"]: "stage-read", _STAGES["write"]: "stage-write"}
_MARKERS = {"trainable": "o", "fixed": "s", "baseline": "D"}
# Inches: in the page it is shown at a width at which its text has about the size of other text.
_WIDTH, _HEIGHT = 6.4, 4.4
# Room for the labels of the vertical ticks, in points.
_TICK_ROOM = 46.0
_STYLE: Any = {
    "axes.axisbelow": True,
    "axes.edgecolor": _MUTED,
    "axes.facecolor": "none",
    "axes.labelcolor": _INK,
    "axes.linewidth": 0.7,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.xmargin": 0.06,
    "axes.ymargin": 0.06,
    "figure.dpi": 72,
    "figure.facecolor": "none",
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "grid.color": _RULE,
    "grid.linewidth": 0.6,
    "savefig.facecolor": "none",
    "svg.fonttype": "none",
    "svg.hashsalt": "mcdenoise",
    "text.color": _INK,
    # A method's name is no formula, even with a dollar sign in it.
    "text.parse_math": False,
    "xtick.color": _MUTED,
    "ytick.color": _MUTED,
    "xtick.labelcolor": _INK,
    "ytick.labelcolor": _INK,
}


@contextmanager
def plot_style() -> Iterator[None]:
    """The look of every plot: make and save figures inside."""
    with matplotlib.rc_context():
        # The settings of a file matplotlibrc in the working folder are not for these plots.
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        yield


def model_colors(methods: Sequence[Method]) -> dict[str, str]:
    """A colour for each model, whatever its settings, baselines grey; the first that learns has the first colour.

    Returns:
        ``#rrggbb`` by name of the model.
    """
    kinds = {kind: [method.model for method in methods if method.kind == kind] for kind in _MARKERS}
    models = dict.fromkeys(kinds["trainable"] + kinds["fixed"])
    colors = {model: _COLORS[index % len(_COLORS)] for index, model in enumerate(models)}
    return dict.fromkeys(kinds["baseline"], _BASELINE) | colors


def css_color(color: str) -> str:
    """A colour of the plots as the style sheet knows it."""
    return f"var(--{_VARIABLES[color]})" if color in _VARIABLES else color


def stage_colors() -> dict[str, str]:
    """The colour of each stage's bars, as :func:`css_color` gives it."""
    return {stage: css_color(color) for stage, color in _STAGES.items()}


def error_over_time(view: View, metric: str, colors: dict[str, str]) -> Figure:
    """Error of each method over its milliseconds a frame, with quartiles and the Pareto front.

    Args:
        view: the methods.
        metric: name in :data:`mcdenoise.evaluate.METRICS`.
        colors: of :func:`model_colors`.
    """
    higher = METRICS[metric].higher_is_better
    figure, axes = _figure(f"{metric} ({'higher' if higher else 'lower'} is better)")
    shown = points(view, metric)
    idle = [row for row in view.rows if row.milliseconds and row.milliseconds.value == 0 and metric in row.errors]
    axes.set_xlabel("milliseconds a frame, without reading and writing files")
    if not shown:
        return _empty(figure)
    best = [row.number for row in front(view, metric)]
    for row, x, y in shown:
        about: Any = {"color": colors[row.method.model], "linewidth": 1.1, "alpha": 0.65, "zorder": 3}
        axes.plot((x.lower, x.upper), (y.value, y.value), **about)
        axes.plot((x.value, x.value), (y.lower, y.upper), **about)
        _mark(axes, row.method, row.number, x.value, y.value, colors[row.method.model])
        _write_number(axes, row.number, x.value, y.value, bold=row.number in best)
    _log_axis(axes.xaxis)
    if not higher:
        _log_axis(axes.yaxis)
    # What follows must not move the limits.
    axes.autoscale_view()
    axes.set_autoscale_on(False)
    places = {row.number: (time.value, error.value) for row, time, error in shown}
    _draw_front(axes, [places[number] for number in best])
    _draw_idle(axes, idle, metric)
    return figure


def stage_bars(view: View) -> Figure:
    """How the median time of each method divides into stages, files included."""
    rows = [row for row in view.rows if row.stages]
    figure, axes = _axes(0.75 + 0.44 * max(len(rows), 1), left=6)
    axes.grid(axis="x")
    axes.spines["left"].set_visible(False)
    axes.yaxis.set_major_locator(NullLocator())
    axes.set_xlabel("milliseconds a frame, medians of the stages")
    if not rows:
        return _empty(figure)
    for place, row in enumerate(rows):
        left = 0.0
        for stage, time in row.stages.items():
            axes.barh(-place, time.value, left=left, height=0.36, color=_STAGES[stage], edgecolor=_PAPER, linewidth=0.4)
            left += time.value
        axes.text(0, -place + 0.24, row.method.name, fontsize=9, va="bottom")
        about: Any = {"textcoords": "offset points", "fontsize": 8.5, "va": "center", "color": _MUTED}
        axes.annotate(f"{left:.0f}" if left >= 100 else f"{left:.3g}", (left, -place), (4, 0), **about)
    axes.set_ylim(-len(rows) + 0.6, 0.85)
    axes.set_xlim(0, 1.12 * max(sum(time.value for time in row.stages.values()) for row in rows))
    return figure


def cost_over_pixels(results: Results, colors: dict[str, str]) -> Figure:
    """Milliseconds over megapixels: medians with quartiles, and the lines fitted to them."""
    figure, axes = _figure("milliseconds a frame, without files")
    axes.set_xlabel("megapixels a frame")
    measured = [(cost, cost.milliseconds) for cost in results.costs if cost.milliseconds is not None]
    if not measured:
        return _empty(figure)
    fits = {fit.method: fit for fit in results.fits}
    for number, method in enumerate(results.methods, start=1):
        own = [(cost.width * cost.height / 1e6, spread) for cost, spread in measured if cost.method == method.name]
        own.sort()
        if not own:
            continue
        color = colors[method.model]
        if method.name in fits:
            fit = fits[method.name]
            steps = np.geomspace(own[0][0], own[-1][0], 33).tolist()
            line = [(x, fit.fixed + fit.per_megapixel * x) for x in steps]
            # A fit with a negative fixed part has no logarithm near zero.
            line = [(x, y) for x, y in line if y > 0]
            axes.plot(*zip(*line, strict=True), color=color, linewidth=1.2, zorder=2)
        for x, spread in own:
            axes.plot([x, x], [spread.lower, spread.upper], color=color, linewidth=1.1)
            _mark(axes, method, number if x == own[0][0] else 0, x, spread.median, color)
        _write_number(axes, number, own[-1][0], own[-1][1].median)
    _log_axis(axes.xaxis)
    _log_axis(axes.yaxis)
    return figure


def error_over_samples(curves: dict[str, list[tuple[int, float]]], title: str) -> Figure:
    """Error over samples a pixel; a curve each.

    Args:
        curves: by name, samples and error, at least one point each; the input is the one called ``input``.
        title: name of the error.
    """
    figure, axes = _figure(title)
    axes.set_xlabel("samples a pixel")
    if not any(curves.values()):
        return _empty(figure)
    colors = iter(_COLORS * (1 + len(curves) // len(_COLORS)))
    for name, own in curves.items():
        color = _BASELINE if name == "input" else next(colors)
        axes.plot(*zip(*own, strict=True), color=color, linewidth=1.4, marker="o", markersize=4, label=name)
    _log_axis(axes.xaxis)
    _log_axis(axes.yaxis)
    return figure


def write_figure(figure: Figure, path: Path) -> None:
    """Write a figure on white, for papers, as its ending says, with a legend of its numbers and colours.

    Raises:
        InputError: the ending is unknown, or the file cannot be written.
    """
    kind = path.suffix.removeprefix(".")
    if kind not in figure.canvas.get_supported_filetypes():
        raise InputError(f"{path}: expected a figure's ending such as .svg, .png or .pdf, found '{path.suffix}'")
    axes = figure.axes[0]
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    with atomic_path(path) as temporary:
        metadata = {"Date": None} if kind == "svg" else None
        figure.savefig(temporary, format=kind, dpi=220, facecolor="white", metadata=metadata, bbox_inches="tight")


def inline_svg(figure: Figure, name: str, description: str) -> str:
    """The figure as an ``<svg>`` element: text as text, colours as variables of the page, ids of its own.

    Args:
        figure: to draw.
        name: unique in the page.
        description: text for screen readers.
    """
    file = io.StringIO()
    figure.savefig(file, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    svg = file.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<!--.*?-->\s*|<metadata>.*?</metadata>\s*|<style.*?</style>\s*", "", svg, flags=re.S)
    svg = re.sub(r' xmlns(:\w+)?="[^"]*"', "", svg).replace("xlink:href", "href")
    for color, variable in _VARIABLES.items():
        svg = svg.replace(color, f"var(--{variable})")
    used = set(re.findall(r'(?:url\(|href=")#([^)"]+)', svg))
    svg = re.sub(r' id="([^"]+)"', lambda found: f' id="{name}-{found[1]}"' if found[1] in used else "", svg)
    svg = re.sub(r'(url\(|href=")#', rf"\1#{name}-", svg)
    svg = re.sub(r' (?:d|x|y|transform)="[^"]*"', lambda found: re.sub(r"(\.\d\d)\d+", r"\1", found[0]), svg)
    head, rest = svg.split(">", 1)
    head = re.sub(r' (width|height|version)="[^"]*"', "", head)
    return f'{head} role="img" aria-label="{escape(description)}">{rest}'


def _figure(title: str) -> tuple[Figure, Axes]:
    figure, axes = _axes(_HEIGHT, left=_TICK_ROOM)
    axes.grid(True)
    axes.tick_params(length=3)
    axes.set_title(title, loc="left", fontsize=9.5, color=_INK)
    return figure, axes


def _axes(height: float, *, left: float) -> tuple[Figure, Axes]:
    """Axes in a new figure, inches; ``left`` is the room for the ticks' labels in points.

    Margins are fixed, because finding them takes longer than everything else, and there are many plots.
    """
    figure = Figure(figsize=(_WIDTH, height))
    across, up = 1 / (72 * _WIDTH), 1 / (72 * height)
    figure.subplots_adjust(left=left * across, right=1 - 6 * across, bottom=36 * up, top=1 - 22 * up)
    return figure, figure.add_subplot()


def _empty(figure: Figure) -> Figure:
    (axes,) = figure.axes
    axes.text(0.5, 0.5, "nothing to show", transform=axes.transAxes, ha="center", color=_MUTED)
    return figure


def _log_axis(axis: Axis) -> None:
    """Make an axis logarithmic, with round numbers, after everything that its range depends on has been drawn."""
    across = axis is axis.axes.xaxis
    (axis.axes.set_xscale if across else axis.axes.set_yscale)("log")
    low, high = axis.axes.get_xlim() if across else axis.axes.get_ylim()
    # Within a decade equal steps look nearly equal.
    few = (
        MaxNLocator(6, steps=[1, 2, 5, 10])
        if high < 10 * low
        else LogLocator(subs=(1, 2, 5) if high < 1e3 * low else (1,))
    )
    axis.set_major_locator(few)
    axis.set_major_formatter(FormatStrFormatter("%g"))
    axis.set_minor_locator(NullLocator())


def _mark(axes: Axes, method: Method, number: int, x: float, y: float, color: str) -> None:
    """Draw a point; one with a number stands in the legend."""
    about: Any = {"markersize": 6.5, "markeredgecolor": _PAPER, "markeredgewidth": 0.8, "zorder": 4}
    axes.plot(x, y, _MARKERS[method.kind], color=color, label=f"{number}  {method.name}" if number else None, **about)


def _draw_front(axes: Axes, front: Sequence[tuple[float, float]]) -> None:
    """Draw the least error for each run time: steps from each point of the front to the time of the next."""
    x, y = [value for value, _ in front], [value for _, value in front]
    far, worst = axes.get_xlim()[1], axes.get_ylim()[axes.get_ylim()[1] > 0 and y[0] >= y[-1]]
    axes.step([x[0], *x, far], [worst, *y, y[-1]], where="post", color=_MUTED, linewidth=0.9, linestyle=(0, (4, 3)))


def _draw_idle(axes: Axes, rows: Sequence[Row], metric: str) -> None:
    """Note methods without a run time, which a logarithmic axis lacks, and draw a line across at their error."""
    for row in rows:
        axes.axhline(row.errors[metric].value, color=_BASELINE, linewidth=0.8, linestyle=":")
    text = ", ".join(f"{row.method.name} {row.errors[metric].value:.3g}" for row in rows)
    if text:
        about: Any = {"ha": "right", "va": "bottom", "fontsize": 8.5, "color": _MUTED}
        axes.text(1.0, 1.015, f"{text} (0 ms)", transform=axes.transAxes, **about)


def _write_number(axes: Axes, number: int, x: float, y: float, bold: bool = False) -> None:
    about: Any = {"textcoords": "offset points", "ha": "center", "va": "center", "zorder": 5}
    axes.annotate(f"{number}", (x, y), (8, 8), fontsize=9, fontweight="bold" if bold else "normal", **about)
