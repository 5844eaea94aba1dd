"""`mcdenoise models`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from statistics import mean

from rich.markup import escape
from rich.table import Column, Table

from mcdenoise.cli._options import Json
from mcdenoise.cli._output import console_of_tables, show, warn, write_json
from mcdenoise.models import ModelOverview, overview, troubles

_MEASURED = ("SMAPE", "ms a frame")
# In a narrower terminal the descriptions take the place of these columns.
_WIDE = 160
_ONLY_WIDE = {"paper", "uses", "parameters", "kMAC per pixel"}
_WEIGHTS = """weights:
  shipped   They come with the package.
  compared  They come with the package, for comparisons only: the training was short.
  to train  None come with the package: train them with `mcdenoise train`.
  its own   The model finds them itself.
  -         The method has none."""
# Buffers from which motion is computed; a model uses those that a frame has.
_MOTION = {"motion", "position", "previous_position", "view_projection"}


def models(results: Path | None = None, json: Json = None) -> None:
    """List the models by kind: paper, required and used buffers, weights, parameters, and operations per pixel.

    The column "uses" lists `motion` if a model uses motion buffers, or positions with cameras, whichever a frame has.

    Args:
        results: folder of a finished `mcdenoise benchmark`, for columns of error and run time: means over its scenes,
            for the models that it measured with their shipped weights and default settings.
        json: write the list to this file too.
    """
    measured = _measured(results) if results else {}
    entries = overview()
    hidden = _ONLY_WIDE if console_of_tables().width < _WIDE else set()
    for kind in dict.fromkeys(entry.kind for entry in entries):
        rows = [_row(entry, measured) for entry in entries if entry.kind == kind]
        columns = [name for name in rows[0] if name not in hidden and (results or name not in _MEASURED)]
        headers = (Column(name, no_wrap=name == "model", overflow="fold") for name in columns)
        table = Table(*headers, title=kind, title_justify="left")
        for row in rows:
            table.add_row(*(row[name] for name in columns))
        show(table)
    print(_WEIGHTS)
    if hidden:
        print(f"not shown, for lack of width (see --json): {', '.join(sorted(hidden))}")
    warn(troubles())
    write_json(json, [asdict(entry) for entry in entries])


def _row(entry: ModelOverview, measured: dict[str, tuple[str, str]]) -> dict[str, str]:
    """The cells of a model by column."""
    motion = ["motion"] if _MOTION & set(entry.uses) else []
    return {
        "model": entry.name,
        "paper": entry.paper or "-",
        "needs": ", ".join(entry.needs) or "-",
        "uses": ", ".join([*(name for name in entry.uses if name not in _MOTION), *motion]) or "-",
        "weights": "not available" if entry.reason else entry.weights if entry.weights != "none" else "-",
        "parameters": f"{entry.parameters:,}" if entry.parameters else "-",
        "kMAC per pixel": "-" if entry.kmacs_per_pixel is None else f"{entry.kmacs_per_pixel:.1f}",
        **dict(zip(_MEASURED, measured.get(entry.name, ("-", "-")), strict=True)),
        "description": escape(entry.reason or entry.description),
    }


def _measured(folder: Path) -> dict[str, tuple[str, str]]:
    """Mean SMAPE and milliseconds of each model that has both on every scene of a benchmark."""
    # Imported here because it loads the readers of files, which is slow.
    from mcdenoise.results import Results

    results, found = Results.read(folder), {}
    for method in results.methods:
        cells = [cell for cell in results.cells if cell.method == method.name == method.model]
        errors = [cell.errors["SMAPE"] for cell in cells if "SMAPE" in cell.errors]
        times = [cell.computing.median for cell in cells if cell.computing]
        if errors and len(errors) == len(times) == len(results.scenes):
            found[method.name] = (f"{mean(errors):.4f}", f"{mean(times):.1f}")
    return found
