"""`mcdenoise ops`."""

from __future__ import annotations

from dataclasses import asdict

from rich.table import Table

from mcdenoise.check.overview import overview
from mcdenoise.cli._options import Json
from mcdenoise.cli._output import show, write_json


def ops(json: Json = None) -> None:
    """List the operators with a description, their differentiable arguments, and their error in each precision.

    Args:
        json: also write the list to this file.
    """
    entries = overview()
    table = Table("op", "what", "differentiable in", "cases", "float32", "bfloat16", "float16")
    for entry in entries:
        errors = (f"{entry.errors[name]:.0e}" for name in ("float32", "bfloat16", "float16"))
        table.add_row(entry.name, entry.summary, ", ".join(entry.differentiable), str(entry.cases), *errors)
    show(table)
    write_json(json, [asdict(entry) for entry in entries])
