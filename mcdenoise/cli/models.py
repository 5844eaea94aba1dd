"""`mcdenoise models`."""

from __future__ import annotations

from dataclasses import asdict

from rich.markup import escape
from rich.table import Table

from mcdenoise.cli._options import Json
from mcdenoise.cli._output import show, write_json
from mcdenoise.models import overview

# What tells motion: a model takes whichever of it there is.
_MOTION = {"motion", "position", "previous_position", "view_projection"}


def models(json: Json = None) -> None:
    """List the models by kind: their paper, what they need and use, weights, parameters, and operations per pixel.

    A model uses `motion` if it takes motion, or positions with cameras, or whichever of them there is.

    Args:
        json: write the list to this file too.
    """
    entries = overview()
    columns = ("model", "paper", "needs", "uses", "weights", "parameters", "kMAC per pixel", "what")
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
                escape(entry.reason or entry.description),
            )
        show(table)
    write_json(json, [asdict(entry) for entry in entries])
