"""Writing the report of a benchmark."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mcdenoise.data.files import make_folder, write_text
from mcdenoise.errors import import_optional
from mcdenoise.evaluate import METRICS
from mcdenoise.report.gallery import REFERENCE, Gallery, kept_pictures, read_gallery
from mcdenoise.report.pictures import BRIGHTEST, FORMATS, data_uri, decode
from mcdenoise.report.views import Range, Row, View, front, metrics, rank, shortlist, views
from mcdenoise.results import STAGES, Kind, Results

FILE = "index.html"
PLOTS = "plots"
# The end of the heat map of SMAPE; larger errors look the same.
_HEAT_END = 0.5
# Methods of a page: more names than these cover one another in a plot.
_MOST_METHODS = 12


def write_report(folder: Path) -> Path:
    """Write ``index.html``, and ``plots/*.svg`` and ``plots/*.png``, from a finished benchmark.

    At most a dozen methods are shown: baselines, the best setting of each model, and the Pareto front. The others are
    named, and their figures are in ``results.csv``.

    The page is one file that needs no network and no server: an image comparer, close-ups, plots, tables that sort, and
    temporal profiles. Its pictures are 8-bit previews, which are coarser the more there are, and at last smaller; every
    figure is of the full data.

    Args:
        folder: with ``results.json`` and, where pictures were kept, ``images/``.

    Returns:
        The path of ``index.html``.

    Raises:
        InputError: the results are missing or damaged, a picture is, a package of ``mcdenoise[report]`` is not
            installed, or a file cannot be written.
    """
    everything = Results.read(folder)
    names = metrics(everything)
    check_packages()
    results = shortlist(everything, _MOST_METHODS)
    galleries = _galleries(folder, results)
    shown = views(results)
    # Open Image Denoise at its best, or else the best filter, and the best network.
    rival, ours = (_best(shown[0], next(iter(names), ""), kind) for kind in ("fixed", "trainable"))
    first = [(rival or shown[0].rows[0]).method.name, ours.method.name if ours else REFERENCE]
    content = {
        "results": results,
        "others": [method.name for method in everything.methods if method not in results.methods],
        "verdict": _verdict(rival, ours, names[0]) if rival and ours else "",
        "created": f"{results.created[:16].replace('T', ' ')} UTC",
        "metrics": [_metric(name) for name in names],
        "columns": [_column(shown, name) for name in names],
        "views": shown,
        "stages": STAGES,
        "number": _number,
        "plots": _write_plots(folder, results, shown, names),
        "skipped": everything.skipped(),
        "sizes": sorted({(cost.width, cost.height) for cost in results.costs}, key=lambda size: size[0] * size[1]),
        "costs": {(cost.method, cost.width, cost.height): cost for cost in results.costs},
        "fits": {fit.method: fit for fit in results.fits},
        "galleries": galleries,
        "reference": REFERENCE,
        "heat": {"end": _HEAT_END, "gradient": ", ".join(f"rgb({r} {g} {b})" for r, g, b in _heat_colors()[::15])},
        "brightest": f"{BRIGHTEST:g}",
        "close_ups": any(gallery.close_ups for gallery in galleries),
        "profiles": any(gallery.profiles for gallery in galleries),
        # The methods shown at first in close-ups and profiles.
        "featured": {results.methods[0].name, *first, REFERENCE},
    } | _comparer(galleries, first)
    path = folder / FILE
    write_text(path, render_page("report.html.jinja", content))
    return path


def write_sample_plots(curves: Mapping[str, dict[str, list[tuple[int, float]]]], folder: Path) -> list[Path]:
    """Draw SMAPE over samples, ``plots/NAME-over-samples.svg``.

    Args:
        curves: by name of the figure, and of the curve: samples and SMAPE.
        folder: of the benchmark.

    Raises:
        InputError: a package is not installed, or a file cannot be written.
    """
    check_packages()
    from mcdenoise.report import plots

    written = []
    for name, own in curves.items():
        path = folder / PLOTS / f"{name}-over-samples.svg"
        make_folder(path.parent)
        with plots.plot_style():
            plots.write_figure(plots.error_over_samples(own, f"SMAPE, {name} (lower is better)"), path)
        written.append(path)
    return written


def check_packages() -> None:
    """See that a report can be written.

    Raises:
        InputError: a package of ``mcdenoise[report]`` is not installed.
    """
    for package in ("jinja2", "matplotlib", "PIL"):
        import_optional(package, "a report", "report")


def render_page(template: str, content: dict[str, Any]) -> str:
    """A page in the style of all reports.

    Args:
        template: name of a file in ``report/page``.
        content: values for the template by name; a name that the template uses and that is missing is an error.

    Raises:
        InputError: a package of ``mcdenoise[report]`` is not installed.
    """
    jinja2 = import_optional("jinja2", "a report", "report")
    page = Path(__file__).parent / "page"
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(page),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # Methods and frames are in an order of their own.
    environment.policies["json.dumps_kwargs"] = {"sort_keys": False}
    parts = {name: (page / f"report.{name}").read_text(encoding="utf-8") for name in ("css", "js")}
    return str(environment.get_template(template).render(**content, **parts))


def _write_plots(folder: Path, results: Results, shown: list[View], names: list[str]) -> dict[str, Any]:
    """Plots as files, and for the page."""
    from mcdenoise.report import plots

    target = folder / PLOTS
    make_folder(target)
    colors = plots.model_colors(results.methods)
    errors: list[dict[str, Any]] = []
    stages: list[dict[str, Any]] = []

    def made(name: str, description: str, figure: Any) -> str:
        inline = plots.inline_svg(figure, name, description)
        for suffix in ("svg", "png"):
            plots.write_figure(figure, target / f"{name}.{suffix}")
        return inline

    with plots.plot_style():
        for place, view in enumerate(shown):
            suffix = _file_name(view.name, place)
            for metric in names:
                described = f"{metric} over milliseconds a frame, {view.name}; the table below has the figures"
                figure = plots.error_over_time(view, metric, colors)
                best = [row.method.name for row in front(view, metric)]
                plot = made(f"{metric.lower()}-{suffix}", described, figure)
                errors.append({"view": place, "metric": metric, "front": best, "plot": plot})
            if any(row.stages for row in view.rows):
                described = f"Milliseconds of each stage, {view.name}; the table below has the figures"
                stages.append({"view": place, "plot": made(f"stages-{suffix}", described, plots.stage_bars(view))})
        described = "Milliseconds a frame over megapixels; the table below has the figures"
        cost = made("cost", described, plots.cost_over_pixels(results, colors)) if results.costs else ""
    return {
        "errors": errors,
        "stages": stages,
        "cost": cost,
        "colors": {model: plots.css_color(color) for model, color in colors.items()},
        "stage_colors": plots.stage_colors(),
    }


def _file_name(name: str, place: int) -> str:
    """A name that is safe in a path; the place keeps it unique if characters had to go."""
    safe = "".join(letter if letter.isalnum() or letter in "-_" else "-" for letter in name)
    # File systems allow 255 bytes a name, including prefix and suffix; a letter has up to four.
    return safe if safe == name and len(name) <= 40 else f"{safe[:40]}-{place}"


def _galleries(folder: Path, results: Results) -> list[Gallery]:
    kept = ((scene, own) for scene in results.scenes for own in kept_pictures(folder, results, scene).values())
    pixels, factor = sum(scene.width * scene.height * len(own) for scene, own in kept), 1
    while pixels > FORMATS[-1][0] * factor**2:
        factor *= 2
    return [read_gallery(folder, results, scene, factor=factor) for scene in results.scenes]


def _comparer(galleries: list[Gallery], first: list[str]) -> dict[str, Any]:
    """The data of the comparer's script: the pictures, their format, and the two to begin with."""
    pixels = sum(codes.size // 3 for gallery in galleries for own in gallery.codes.values() for codes in own.values())
    kind, options = next((kind, options) for most, kind, options in FORMATS if pixels <= most)
    scenes = [
        {
            "name": gallery.scene.name,
            "width": gallery.scene.width // gallery.factor,
            "height": gallery.scene.height // gallery.factor,
            "frames": gallery.scene.pictures,
            "exposure": gallery.exposure,
            # The frame of the close-ups, which has a reference, or else the last one.
            "start": gallery.scene.pictures.index(max(gallery.codes.get(REFERENCE) or gallery.scene.pictures)),
            "pictures": {
                name: {str(number): data_uri(codes, kind, **options) for number, codes in own.items()}
                for name, own in gallery.codes.items()
            },
        }
        for gallery in galleries
        if gallery.codes
    ]
    return {
        "format": "lossless WebP" if kind == "webp" else f"JPEG of quality {options['quality']}",
        "factor": max((gallery.factor for gallery in galleries), default=1),
        "data": {
            "scenes": scenes,
            "linear": [float(f"{value:.5g}") for value in decode(np.arange(256)).tolist()],
            "heat": _heat_colors(),
            "heatEnd": _HEAT_END,
            "first": first,
        },
    }


def _best(view: View, metric: str, kind: Kind) -> Row | None:
    """The best method of a kind in a metric; of those that are not trained, Open Image Denoise at its best."""
    rows = [row for row in view.rows if row.method.kind == kind and metric in row.errors]
    rows = [row for row in rows if row.method.model == "oidn"] or rows
    return min(rows, key=lambda row: rank(row, metric), default=None)


def _verdict(rival: Row, ours: Row, metric: str) -> str:
    """The best network beside the best of the others, in a sentence; empty where they cannot be compared."""
    one, other = (row.errors[metric].value for row in (ours, rival))
    if METRICS[metric].higher_is_better:
        text = f"{ours.method.name}: {metric} {one:.3g}, {rival.method.name}: {other:.3g}"
    elif other <= 0:
        return ""
    else:
        change = one / other - 1
        text = f"{ours.method.name} has {abs(change):.0%} {'less' if change < 0 else 'more'} error ({metric}) than "
        text += rival.method.name
    if ours.milliseconds and rival.milliseconds and rival.milliseconds.value > 0:
        ratio = ours.milliseconds.value / rival.milliseconds.value
        text += ", in the same time" if 0.95 < ratio < 1.05 else f", in {ratio:.2g} times its time"
    return f"{text}."


def _metric(name: str) -> dict[str, Any]:
    """Its name, which way is better, and the first line of its docstring in parts, every other one of them code."""
    line = (METRICS[name].function.__doc__ or "").strip().splitlines()[0]
    return {"name": name, "higher": METRICS[name].higher_is_better, "text": line.split("``")}


def _column(shown: list[View], name: str) -> dict[str, Any]:
    """How a metric's column is printed, and the best value in it for each view."""
    metric = METRICS[name]
    values = [[row.errors[name].value for row in view.rows if name in row.errors] for view in shown]
    finite = [abs(value) for own in values for value in own if math.isfinite(value) and value != 0]
    decimals = min(max(2 - math.floor(math.log10(min(finite))), 2), 4) if finite else 2
    best = [min(own, key=metric.rank, default=None) for own in values]
    return {"name": name, "higher": metric.higher_is_better, "decimals": decimals, "best": best}


def _number(value: Range | float | None, decimals: int | None = None) -> str:
    """A figure of a table: a fixed number of decimals, or three digits; empty for an unknown one."""
    if value is None:
        return ""
    figure = value.value if isinstance(value, Range) else value
    if not math.isfinite(figure):
        return "∞" if figure > 0 else ""
    if decimals is not None and abs(figure) < 100:
        return f"{figure:.{decimals}f}"
    return f"{figure:,.0f}" if abs(figure) >= 100 else f"{figure:.3g}"


def _heat_colors() -> list[list[int]]:
    import matplotlib

    return [[round(255 * part) for part in color[:3]] for color in map(matplotlib.colormaps["inferno"], range(256))]
