"""`mcdenoise models`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from statistics import mean

from rich.markup import escape
from rich.table import Table

from mcdenoise.cli._options import Json
from mcdenoise.cli._output import show, write_json
from mcdenoise.models import overview

_MEASURED = ("SMAPE", "ms a frame")
# Alternative sources of motion: a model uses whichever is available.
_MOTION = {"motion", "position", "previous_position", "view_projection"}


def models(results: Path | None = None, json: Json = None) -> None:
    """List the models by kind: their paper, what they need and use, weights, parameters, and operations per pixel.

    A model uses `motion` if it takes motion, or positions with cameras, whichever is available.

    Args:
        results: folder of a finished `mcdenoise benchmark`, for columns with error and run time: means over its scenes,
            for models that were measured with their shipped weights.
        json: also write the list to this file.
    """
    measured = _measured(results) if results else {}
    entries = overview()
    columns = ("model", "paper", "needs", "uses", "weights", "parameters", "kMAC per pixel")
    columns = (*columns, *(_MEASURED if results else ()), "what")
    for kind in dict.fromkeys(entry.kind for entry in entries):
        table = Table(*columns, title=kind, title_justify="left")
        for entry in (each for each in entries if each.kind == kind):
            motion = ["motion"] if _MOTION & set(entry.uses) else []
            table.add_row(
                entry.name,
                entry.paper or "-",
                ", ".join(entry.needs) or "-",
                ", ".join([*(name for name in entry.uses if name not in _MOTION), *motion]) or "-",
                "not available" if entry.reason else entry.weights if entry.weights != "none" else "-",
                f"{entry.parameters:,}" if entry.parameters else "-",
                "-" if entry.kmacs_per_pixel is None else f"{entry.kmacs_per_pixel:.1f}",
                *(measured.get(entry.name, ("-", "-")) if results else ()),
                escape(entry.reason or entry.description),
            )
        show(table)
    write_json(json, [asdict(entry) for entry in entries])


def _measured(folder: Path) -> dict[str, tuple[str, str]]:
    """SMAPE and milliseconds of each model for which every scene of a benchmark has both."""
    # Imported here because it loads the readers of files, which takes time.
    from mcdenoise.results import Results

    results, found = Results.read(folder), {}
    for method in results.methods:
        cells = [cell for cell in results.cells if cell.method == method.name == method.model]
        errors = [cell.errors["SMAPE"] for cell in cells if "SMAPE" in cell.errors]
        times = [cell.computing.median for cell in cells if cell.computing]
        if errors and len(errors) == len(times) == len(results.scenes):
            found[method.name] = (f"{mean(errors):.4f}", f"{mean(times):.1f}")
    return found
