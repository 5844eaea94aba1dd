"""`mcdenoise gradcheck`."""

from __future__ import annotations

from dataclasses import asdict

import tyro
from rich.table import Table

from mcdenoise.check.gradients import check_case, select
from mcdenoise.cli._options import Json
from mcdenoise.cli._output import progress_bar, show, write_json


def gradcheck(ops: tyro.conf.Positional[list[str]] = [], json: Json = None) -> int:  # noqa: B006 - tyro reads it
    """Check first and second derivatives of operators against finite differences, in float64, slow mode.

    A function of your own takes floating-point tensors. What it is tried on is a small tuple of tensors, or several by
    name, that its file gives as `function.example_inputs`, or as `inputs()` for all functions in it; without either,
    images of 6 by 5 pixels for all arguments.

    Args:
        ops: names of operators, or functions of your own, path/to/file.py:function or package.module:function; all
            operators by default.
        json: write the results to this file too.
    """
    table = Table("op", "case", "inputs", "result", "seconds")
    with progress_bar() as progress:
        results = [check_case(op, case) for op, case in progress.track(select(ops or None), description="gradcheck")]
    for result in results:
        outcome = "ok" if result.passed else f"FAILED {result.message}"
        table.add_row(result.op, result.case, ", ".join(result.inputs), outcome, f"{result.seconds:.2f}")
    show(table)
    write_json(json, [asdict(result) for result in results])
    failed = sum(not result.passed for result in results)
    print(f"{len(results)} checks, {failed} failed")
    return 1 if failed else 0
