"""`mcdenoise gradcheck`."""

from __future__ import annotations

from dataclasses import asdict
from typing import Literal

import tyro
from rich.markup import escape
from rich.table import Table

from mcdenoise.check.gradients import check_case, select
from mcdenoise.cli._options import Json
from mcdenoise.cli._output import progress_bar, show, write_json


def gradcheck(
    ops: tyro.conf.Positional[list[str]] = [],  # noqa: B006 - tyro reads it
    order: Literal[1, 2] = 2,
    json: Json = None,
) -> int:
    """Check first and second derivatives of operators against finite differences, in float64, number by number.

    A function of your own takes floating-point tensors. Its example inputs are a small tuple of tensors, or several by
    name, which its file provides as `function.example_inputs`, or as `inputs()` for all functions in it; without
    either, all arguments are images of 6 by 5 pixels.

    Args:
        ops: names of operators, or functions of your own, path/to/file.py:function or package.module:function; all
            operators by default.
        order: 1 for first derivatives only, for example of a function that is differentiable once.
        json: also write the results to this file.
    """
    table = Table("op", "case", "inputs", "result", "seconds")
    with progress_bar() as progress:
        chosen = progress.track(select(ops or None), description="gradcheck")
        results = [check_case(op, case, order) for op, case in chosen]
    for result in results:
        outcome = "ok" if result.passed else f"FAILED {result.message}"
        row = (result.op, result.case, ", ".join(result.inputs), outcome, f"{result.seconds:.2f}")
        # Escape markup in names from users.
        table.add_row(*map(escape, row))
    show(table)
    write_json(json, [asdict(result) for result in results])
    failed = sum(not result.passed for result in results)
    print(f"{len(results)} checks, {failed} failed")
    return 1 if failed else 0
