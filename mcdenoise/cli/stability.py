"""`mcdenoise stability`."""

from __future__ import annotations

from dataclasses import asdict
from operator import attrgetter
from typing import Literal

import torch
import tyro

from mcdenoise.check.stability import FRAMES, LONG_RUNS, VALID_SHOT, Check, groups
from mcdenoise.cli._options import Json
from mcdenoise.cli._output import print_rows, progress_bar, write_json
from mcdenoise.errors import InputError


def stability(
    ops: tyro.conf.Positional[list[str]] = [],  # noqa: B006 - tyro reads it
    models: list[str] = [],  # noqa: B006
    dtypes: list[Literal["float32", "bfloat16", "float16"]] = ["float32", "bfloat16", "float16"],  # noqa: B006
    frames: int = FRAMES,
    json: Json = None,
) -> int:
    """Check operators, models and the denoiser on ordinary, stiff and extreme inputs, and over thousands of frames.

    Errors are in units of the dtype's epsilon times the condition number of the case; bounds come from error analysis.

    A function of your own takes floating-point tensors, and is compared with itself in float64. Its file defines the
    example inputs, a small tuple of tensors or several tuples by name, as `function.example_inputs`, or as `inputs()`
    for all functions in the file; by default every argument is an image of 6 by 5 pixels.

    Args:
        ops: names of operators, or functions of your own, path/to/file.py:function or package.module:function, with
            optional settings, file.py:function(setting=value); all operators by default.
        models: names with optional settings, weights files, or file.py:factory; by default all available models, or
            none if operators are named.
        dtypes: precisions to check.
        frames: number of frames of the long runs.
        json: write every check to this file too.
    """
    if not dtypes:
        raise InputError("--dtypes: expected some of float32, bfloat16, float16, found none")
    if frames < 1:
        raise InputError(f"--frames: expected at least 1, found {frames}")
    chosen = groups(ops or None, models or None, [getattr(torch, name) for name in dtypes], frames)
    checks: list[Check] = []
    with progress_bar() as progress:
        for group in progress.track(chosen, description="stability"):
            checks += group.run()
    runs = [check for check in checks if check.subject == LONG_RUNS]
    _print_checks([check for check in checks if check.subject != LONG_RUNS])
    _print_shots(checks)
    print_rows(
        [
            {
                "long run": run.case,
                "dtype": run.dtype,
                "error": f"{run.error:.2g} of {run.allowed:.2g}" if run.allowed else "-",
                "result": "ok" if run.passed else f"FAILED: {run.message}",
            }
            for run in runs
        ]
    )
    for note in filter(None, (group.note for group in chosen)):
        print(note)
    failed = sum(not check.passed for check in checks)
    write_json(json, {"passed": not failed, "checks": [asdict(check) for check in checks]})
    print(f"{len(checks)} checks, {failed} failed")
    return 1 if failed else 0


def _print_checks(checks: list[Check]) -> None:
    """Print a row for each subject, dtype and backend: the error that is closest to its bound, and that bound."""
    found: dict[tuple[str, str, str], list[Check]] = {}
    for check in checks:
        found.setdefault((check.subject, check.dtype, check.backend), []).append(check)
    rows = []
    for key, own in found.items():
        row = dict(zip(("subject", "dtype", "backend"), key, strict=True))
        row |= {"checks": str(len(own)), "condition": f"{max(check.condition for check in own):.1g}"}
        failed = [check for check in own if not check.passed]
        for what in ("forward", "gradient"):
            worst = max((each for each in own if each.what == what), key=attrgetter("closeness"), default=None)
            row[what] = f"{worst.error:.2g} of {worst.allowed:.2g}" if worst and worst.allowed else "-"
        kinds = dict.fromkeys(check.what for check in own)
        row["holds"] = ", ".join(what for what in kinds if what not in {check.what for check in failed})
        row["result"] = "ok"
        if failed:
            row["result"] = f"{len(failed)} FAILED: {failed[0].what}, {failed[0].case}: {failed[0].message}"
        elif list(kinds) == ["runs"]:
            row |= {"holds": "-", "result": f"not run: {own[0].message}"}
        rows.append(row)
    print_rows(rows)


def _print_shots(checks: list[Check]) -> None:
    """Print a row for each unusual shot: how many denoisers and dtypes had a valid image, and which had none."""
    shots: dict[str, list[Check]] = {}
    for check in checks:
        if check.what == VALID_SHOT:
            shots.setdefault(check.case, []).append(check)
    rows = []
    for case, found in shots.items():
        failed = [f"{check.subject}, {check.dtype}: {check.message}" for check in found if not check.passed]
        result = f"FAILED: {failed[0]}" if failed else "ok"
        rows.append({"shot": case, "checks": str(len(found)), "every image is finite and not negative": result})
    print_rows(rows)
