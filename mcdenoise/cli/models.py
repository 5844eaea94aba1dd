"""`mcdenoise models`."""

from __future__ import annotations

from dataclasses import asdict

from mcdenoise.cli._options import Flag, Json
from mcdenoise.cli._output import console_of_tables, print_rows, warn, write_json
from mcdenoise.models._overview import ModelOverview, overview
from mcdenoise.models._registry import troubles

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


def models(all: Flag = False, ops: Flag = False, json: Json = None) -> None:
    """List the models to use: paper, required and used buffers, weights, parameters, and operations per pixel.

    These have shipped weights; `mcdenoise denoise` takes wild if none is named. The column "uses" lists `motion` if a
    model uses motion buffers, or positions with cameras, whichever a frame has.

    Args:
        all: list every model by kind: also methods of publications to compare with, filters, and other denoisers.
        ops: list the operators instead, with their error against their equation in each precision.
        json: write the list to this file too.
    """
    if ops:
        _list_ops(json)
        return
    entries = overview()
    if not all:
        entries = [entry for entry in entries if entry.weights == "shipped"]
    hidden = _ONLY_WIDE if console_of_tables().width < _WIDE else set()
    for kind in dict.fromkeys(entry.kind for entry in entries):
        rows = [_row(entry) for entry in entries if entry.kind == kind]
        print(kind)
        print_rows([{name: cell for name, cell in row.items() if name not in hidden} for row in rows])
    print(_WEIGHTS if all else "`mcdenoise models --all` also lists the methods to compare with")
    if hidden:
        print(f"not shown, for lack of width (see --json): {', '.join(sorted(hidden))}")
    warn(*troubles())
    write_json(json, [asdict(entry) for entry in entries])


def _row(entry: ModelOverview) -> dict[str, str]:
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
        "description": entry.reason or entry.description,
    }


def _list_ops(json: Json) -> None:
    # Imported here because it loads the cases of all operators.
    from mcdenoise.check.overview import overview as overview_of_ops

    entries = overview_of_ops()
    print_rows(
        [
            {
                "op": entry["name"],
                "description": entry["summary"],
                "differentiable in": ", ".join(entry["differentiable"]),
                "cases": str(entry["cases"]),
                **{dtype: f"{error:.0e}" for dtype, error in entry["errors"].items()},
            }
            for entry in entries
        ]
    )
    write_json(json, entries)
