"""`mcdenoise gradcheck`."""

from __future__ import annotations

from dataclasses import asdict
from typing import Literal

import tyro

from mcdenoise.check.gradients import check_case, select
from mcdenoise.cli._options import Json
from mcdenoise.cli._output import print_rows, progress_bar, write_json


def gradcheck(
    ops: tyro.conf.Positional[list[str]] = [],  # noqa: B006 - tyro reads it
    order: Literal[1, 2] = 2,
    json: Json = None,
) -> int:
    """Check first and second derivatives of operators against finite differences in float64.

    A function of your own takes floating-point tensors, and is checked element by element. Its file defines the example
    inputs, a small tuple of tensors or several tuples by name, as `function.example_inputs`, or as `inputs()` for all
    functions in the file; by default every argument is an image of 6 by 5 pixels.

    Args:
        ops: names of operators, or functions of your own, path/to/file.py:function or package.module:function, with
            optional settings, file.py:function(setting=value); all operators by default.
        order: 1 to check first derivatives only, for functions that can be differentiated once.
        json: write the results to this file too.
    """
    with progress_bar() as progress:
        chosen = progress.track(select(ops or None), description="gradcheck")
        results = [check_case(op, case, order) for op, case in chosen]
    print_rows(
        [
            {
                "op": each.op,
                "case": each.case,
                "inputs": ", ".join(each.inputs),
                "result": "ok" if each.passed else f"FAILED {each.message}",
                "seconds": f"{each.seconds:.2f}",
            }
            for each in results
        ]
    )
    write_json(json, [asdict(result) for result in results])
    failed = sum(not result.passed for result in results)
    print(f"{len(results)} checks, {failed} failed")
    return 1 if failed else 0
