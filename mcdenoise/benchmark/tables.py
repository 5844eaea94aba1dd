"""Results as tables, with one row for each scene and method."""

from __future__ import annotations

import csv
import io
import math
from itertools import groupby
from pathlib import Path
from typing import Any

from mcdenoise.data.files import write_text
from mcdenoise.results import STAGES, Cell, Method, OpResults, Results, Scene, Spread

CSV = "results.csv"
OPS_CSV = "ops.csv"

# Metrics of the printed table; those without any value are skipped.
_SHOWN = ("SMAPE", "PSNR", "SSIM", "FLIP")


def write_csv(results: Results, folder: Path) -> None:
    """Write ``results.csv``: a row for each scene and method, including missing methods."""
    rows = []
    for scene in results.scenes:
        for method in results.methods:
            cell = results.cell(scene.name, method.name)
            missing = Cell(scene.name, method.name, failure=f"missing: {method.missing}")
            rows.append(_row(scene, method, cell or missing, results))
    _write(folder / CSV, rows)


def write_ops_csv(results: OpResults, folder: Path) -> None:
    """Write ``ops.csv``: a row for each op, backend and dtype, each with the machine and the package versions."""
    machine = results.machine
    packages = ", ".join(f"{name} {version}" for name, version in machine.packages.items())
    rows = [
        {
            "op": cost.op,
            "backend": cost.backend,
            "dtype": cost.dtype,
            "width": results.width,
            "height": results.height,
            "case": cost.case,
            "relative error": cost.error,
            **_times("ms", cost.milliseconds),
            "MiB": cost.mebibytes,
            "copy ms": cost.copy,
            "over copy": cost.over_copy,
            **_times("ms with derivatives", cost.with_derivatives),
            "copy ms with derivatives": cost.copy_with_derivatives,
            "over copy with derivatives": cost.over_copy_with_derivatives,
            "failure": cost.failure,
            "created": results.created,
            "processor": machine.processor,
            "device": machine.device,
            "threads": machine.threads,
            "packages": packages,
        }
        for cost in results.costs
    ]
    _write(folder / OPS_CSV, rows)


def scene_rows(results: Results) -> list[dict[str, str]]:
    """Printed rows of the methods that succeeded: error and run time, scene by scene, best method first."""
    rows = []
    names = [name for name in _SHOWN if any(name in cell.errors for cell in results.cells)]
    for scene in results.scenes:
        cells = [cell for cell in results.cells if cell.scene == scene.name and not cell.failure]
        for cell in sorted(cells, key=lambda cell: cell.errors.get("SMAPE", math.inf)):
            rows.append(
                {
                    "scene": scene.name,
                    "method": cell.method,
                    **{name: _number(cell.errors.get(name), ".4g") for name in names},
                    "ms": _number(cell.computing, ".1f"),
                    "quartiles": _range(cell.computing),
                    "ms with files": _number(cell.whole, ".1f"),
                    "megapixels/s": _number(results.megapixels_per_second(cell), ".2f"),
                    "peak MiB": _number(cell.memory, ".0f"),
                }
            )
    return rows


def skipped_rows(results: Results) -> list[dict[str, str]]:
    """Printed rows of the stages that methods skipped on each scene."""
    return [
        {
            "scene": row.scene,
            "method": row.method,
            "skipped": row.stages,
            "ms saved": _number(row.saved, ".1f"),
            **{f"change of {name}": _number(row.change.get(name), "+.1e") for name in _SHOWN if name in row.change},
        }
        for row in results.skipped()
    ]


def remarks(results: Results) -> list[str]:
    """Printed lines below the table: failures, missing methods and skipped metrics, each with its reason."""
    lines = [
        f"{'skipped' if cell.lacking else 'failed'}: {cell.scene}, {cell.method}: {cell.failure}"
        for cell in results.cells
        if cell.failure
    ]
    lines += [
        f"not tried: {one.method}, {one.width}x{one.height}: {one.failure}" for one in results.costs if one.failure
    ]
    missing = sorted((method for method in results.methods if method.missing), key=lambda method: method.missing)
    for reason, methods in groupby(missing, lambda method: method.missing):
        lines.append(f"missing: {'; '.join(method.name for method in methods)}: {reason}")
    return lines + results.notes


def op_rows(results: OpResults) -> list[dict[str, str]]:
    """Printed rows, one for each op, backend and dtype."""
    return [
        {
            "op": cost.op,
            "backend": cost.backend,
            "dtype": cost.dtype,
            "relative error": _number(cost.error, ".1e"),
            "ms": _number(cost.milliseconds, ".2f"),
            "quartiles": _range(cost.milliseconds),
            "MiB": _number(cost.mebibytes, ".1f"),
            "copy ms": _number(cost.copy, ".2f"),
            "/ copy": _number(cost.over_copy, ".1f"),
            "derivatives too, ms": _number(cost.with_derivatives, ".2f"),
            "/ their copy": _number(cost.over_copy_with_derivatives, ".1f"),
            "failure": cost.failure,
        }
        for cost in results.costs
    ]


def _number(value: Spread | float | None, form: str) -> str:
    value = value.median if isinstance(value, Spread) else value
    return "" if value is None else format(value, form)


def _range(spread: Spread | None) -> str:
    return "" if spread is None else f"{spread.lower:.1f} to {spread.upper:.1f}"


def _row(scene: Scene, method: Method, cell: Cell, results: Results) -> dict[str, Any]:
    metrics = dict.fromkeys(name for one in results.cells for name in one.errors)
    errors: dict[str, Any] = {}
    for name in metrics:
        errors |= _times(name, cell.errors_spread.get(name)) | {name: cell.errors.get(name)}
    return {
        "scene": scene.name,
        "method": method.name,
        "kind": method.kind,
        "model": method.model,
        "settings": ", ".join(f"{name}={value}" for name, value in method.settings.items()),
        "precision": method.precision,
        "parameters": method.parameters,
        "width": scene.width,
        "height": scene.height,
        "frames": len(scene.frames),
        "scored": len(scene.scored),
        **errors,
        **_times("ms", cell.computing),
        **_times("whole ms", cell.whole),
        **{f"{stage} ms": cell.stages[stage].median if stage in cell.stages else None for stage in STAGES},
        "megapixels per second": results.megapixels_per_second(cell),
        "peak MiB": cell.memory,
        "failure": cell.failure,
    }


def _times(name: str, spread: Spread | None) -> dict[str, float | None]:
    median, lower, upper = (None, None, None) if spread is None else (spread.median, spread.lower, spread.upper)
    return {name: median, f"{name} lower": lower, f"{name} upper": upper}


def _write(path: Path, rows: list[dict[str, Any]]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0] if rows else [], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, text.getvalue())
