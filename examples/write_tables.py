"""Write the tables and the plot of the documentation from measured figures.

    make figures
    python examples/write_tables.py benchmarks --pages .
    python examples/write_tables.py benchmarks --pages . --check

`make figures` measures first: errors on unseen takes (takes.py) and run times on one frame (run_time.py), each in one
run. A table stands in a page between ``<!-- figures: NAME -->`` and ``<!-- end of figures -->``. With --check nothing
is written, and pages that differ from the figures are an error.
"""

import argparse
import json
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from statistics import geometric_mean, median
from typing import NamedTuple

from takes import METHODS, NOISY, OIDN, TIMED, Rows, ratios

from mcdenoise.data.files import write_text
from mcdenoise.errors import InputError, run_script
from mcdenoise.reading import read_text

PAGES = ("README.md", "docs/results.md", "docs/performance.md")
PLOT = Path("docs/error_and_time.svg")
_TICKS = (100, 300, 1000, 3000, 10000)
# Milliseconds beyond which a name has no room on the right of its point.
_NO_ROOM = 3000
_BETWEEN = re.compile(r"(<!-- figures: (\w+) -->\n).*?(<!-- end of figures -->)", re.DOTALL)


class Figures(NamedTuple):
    """What was measured: errors on unseen takes, and on long ones; milliseconds by name, and precision."""

    takes: Rows
    long: Rows
    times: dict[str, list[float]]


class Errors(NamedTuple):
    """Geometric means, and the worst, of errors over those of Open Image Denoise's best setting of each take."""

    shots: float
    worst_shot: float
    flicker: float
    stills: float
    worst_still: float


def errors_of(takes: Rows, name: str) -> Errors:
    """The errors of a method."""
    shots, stills = (ratios(takes, name, "smape", moving=moving) for moving in (True, False))
    flicker = ratios(takes, name, "tsmape", moving=True)
    return Errors(geometric_mean(shots), max(shots), geometric_mean(flicker), geometric_mean(stills), max(stills))


def milliseconds(times: dict[str, list[float]], name: str) -> dict[str, float]:
    """Medians, by precision."""
    kinds = {"float32": times.get(name), "bfloat16": times.get(f"{name}, bfloat16")}
    return {kind: median(values) for kind, values in kinds.items() if values}


def fastest(times: dict[str, list[float]], name: str) -> list[float]:
    """Medians in the faster precision: with exact features, and with noisy ones if the method denoises them first."""
    names = [name, NOISY[name]] if name in NOISY else [name]
    return [min(milliseconds(times, each).values()) for each in names]


def lines(rows: Iterable[list[str]], heads: list[str]) -> str:
    """A table whose first column is text."""
    head = [heads, ["---", *["--:"] * (len(heads) - 1)]]
    return "\n".join("| " + " | ".join(row) + " |" for row in [*head, *rows]) + "\n"


def table(figures: Figures) -> str:
    """Error and run time of all methods."""
    found = {name: (errors_of(figures.takes, name), fastest(figures.times, name)) for name in METHODS}
    least = [min(column) for column in zip(*(errors for errors, _ in found.values()), strict=True)]

    def cells(errors: Errors) -> list[str]:
        texts = [f"{value:.2f}" for value in errors]
        return [f"**{text}**" if value == low else text for text, value, low in zip(texts, errors, least, strict=True)]

    rows = [
        [METHODS[name], *cells(errors), " to ".join(f"{time:.0f}" for time in times)]
        for name, (errors, times) in found.items()
    ]
    return lines(rows, ["", "shots: error", "worst", "flicker", "stills: error", "worst", "ms"])


def long_table(figures: Figures) -> str:
    """Error and flicker of shots of many frames."""

    def of(name: str, key: str) -> list[float]:
        return ratios(figures.long, name, key, moving=True)

    rows = []
    for name, label in METHODS.items():
        smape, flicker = of(name, "smape"), of(name, "tsmape")
        values = geometric_mean(smape), max(smape), geometric_mean(flicker)
        rows.append([label, *(f"{value:.2f}" for value in values)])
    return lines(rows, ["", "error", "worst", "flicker"])


def time_table(figures: Figures) -> str:
    """Run times in both precisions."""
    found = {name: milliseconds(figures.times, name) for name in TIMED}
    unit = found[next(iter(METHODS))]["float32"]
    rows = [
        [
            TIMED[name],
            *(f"{each[kind]:.0f}" if kind in each else "" for kind in ("float32", "bfloat16")),
            f"{min(each.values()) / unit:.2f}",
        ]
        for name, each in found.items()
    ]
    return lines(rows, ["method", "float32, ms", "bfloat16, ms", "over OIDN fast"])


def single_table(figures: Figures) -> str:
    """Every take: SMAPE of each method but the first, OIDN fast."""
    _, *shown = METHODS
    rows = []
    for number, row in sorted(figures.takes.items()):
        values = [row[name]["smape"] for name in shown]
        texts = [f"**{value:.4f}**" if value == min(values) else f"{value:.4f}" for value in values]
        rows.append([f"{number}, {'shot' if 'tsmape' in row[OIDN[0]] else 'still'}", *texts])
    return lines(rows, ["take", *(METHODS[name] for name in shown)])


TABLES: dict[str, Callable[[Figures], str]] = {
    "errors": table,
    "long": long_table,
    "times": time_table,
    "takes": single_table,
}


def plot(figures: Figures, path: Path) -> None:
    """Error over run time, of shots and of stills."""
    from matplotlib.figure import Figure

    from mcdenoise.report.plots import plot_style, write_figure

    with plot_style():
        figure = Figure((8, 3.6), layout="constrained")
        for axes, kind in zip(figure.subplots(1, 2, sharey=True), ("shots", "stills"), strict=True):
            for name, label in METHODS.items():
                time = max(fastest(figures.times, name))
                error = getattr(errors_of(figures.takes, name), kind)
                # Labels of the two kinds are on different sides of their points, and do not meet.
                color, mark, height = ("#0072b2", "o", -10) if name.startswith("wild") else ("#d55e00", "s", 4)
                axes.plot(time, error, mark, color=color)
                side = "right" if time > _NO_ROOM else "left"
                place = (-6 if side == "right" else 6, height)
                text = label.strip("`").partition(",")[0]
                axes.annotate(text, (time, error), place, textcoords="offset points", ha=side, fontsize=8)
            axes.margins(y=0.1)
            axes.set(title=kind, xscale="log", xlabel="ms for 1280x720")
            axes.set_xticks(_TICKS, [str(tick) for tick in _TICKS])
            axes.minorticks_off()
            axes.axhline(1, color="#767676", linewidth=0.7)
        figure.axes[0].set_ylabel("SMAPE over OIDN's best setting")
        write_figure(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("figures", type=Path, metavar="FOLDER", help="with takes.json, long.json and run-time.json")
    parser.add_argument("--pages", type=Path, default=Path(), metavar="FOLDER", help="where README.md and docs are")
    parser.add_argument("--check", action="store_true", help="only compare the pages with the figures")
    options = parser.parse_args()
    takes, long = (json.loads(read_text(options.figures / name)) for name in ("takes.json", "long.json"))
    times = json.loads(read_text(options.figures / "run-time.json"))["milliseconds"]
    times = {name.replace(", auxiliary", ",auxiliary"): values for name, values in times.items()}
    figures = Figures(takes, long, times)
    for name in PAGES:
        before = read_text(options.pages / name)
        after = _BETWEEN.sub(lambda found: found[1] + TABLES[found[2]](figures) + found[3], before)
        if options.check and after != before:
            raise InputError(f"{name}: expected the tables of {options.figures}, found others; run make figures")
        if after != before:
            write_text(options.pages / name, after)
    if not options.check:
        plot(figures, options.pages / PLOT)


if __name__ == "__main__":
    run_script(main)
