"""`mcdenoise models`."""

from __future__ import annotations

from dataclasses import asdict

from rich.table import Table

from mcdenoise.cli._options import Json
from mcdenoise.cli._output import show, write_json
from mcdenoise.models import overview


def models(json: Json = None) -> None:
    """List the models with parameters, operations per pixel, and whether weights are shipped.

    Args:
        json: write the list to this file too.
    """
    entries = overview()
    table = Table("model", "parameters", "kMAC per pixel", "weights", "what")
    for entry in entries:
        shipped = "shipped" if entry.pretrained else "-"
        table.add_row(entry.name, f"{entry.parameters:,}", f"{entry.kmacs_per_pixel:.1f}", shipped, entry.description)
    show(table)
    write_json(json, [asdict(entry) for entry in entries])
