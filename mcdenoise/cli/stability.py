"""`mcdenoise stability`."""

from __future__ import annotations

import tyro

from mcdenoise.check.stability import (
    FRAMES,
    VALID_SHOT,
    Check,
    LongRun,
    Summary,
    as_json,
    groups,
    parse_dtypes,
    summarize,
)
from mcdenoise.cli._options import Json
from mcdenoise.cli._output import print_rows, progress_bar, write_json
from mcdenoise.errors import InputError


def stability(
    ops: tyro.conf.Positional[list[str]] = [],  # noqa: B006 - tyro reads it
    models: list[str] = [],  # noqa: B006
    dtypes: list[str] = ["float32", "bfloat16", "float16"],  # noqa: B006
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
        json: write every check to this file too, and the errors of the long runs over time.
    """
    if frames < 1:
        raise InputError(f"--frames: expected at least 1, found {frames}")
    chosen = groups(ops or None, models or None, parse_dtypes(dtypes), frames)
    checks: list[Check] = []
    runs: list[LongRun] = []
    with progress_bar() as progress:
        for group in progress.track(chosen, description="stability"):
            for result in group.run():
                checks.append(result) if isinstance(result, Check) else runs.append(result)
    _print_checks(checks)
    _print_shots(checks)
    _print_long_runs(runs)
    for note in filter(None, (group.note for group in chosen)):
        print(note)
    write_json(json, as_json(checks, runs))
    failed = sum(not check.passed for check in checks) + sum(not run.passed for run in runs)
    print(f"{len(checks) + len(runs)} checks, {failed} failed")
    return 1 if failed else 0


def _print_checks(checks: list[Check]) -> None:
    """Print a row for each subject, dtype and backend: the error that is closest to its bound, and that bound."""
    found: dict[tuple[str, str, str], dict[str, Summary]] = {}
    for summary in summarize(checks):
        found.setdefault((summary.subject, summary.dtype, summary.backend), {})[summary.what] = summary
    rows = []
    for key, summaries in found.items():
        row = dict(zip(("subject", "dtype", "backend"), key, strict=True))
        row["checks"] = str(sum(summary.checks for summary in summaries.values()))
        row["condition"] = f"{max(summary.condition for summary in summaries.values()):.1g}"
        for what in ("forward", "gradient"):
            worst = summaries[what].worst if what in summaries else None
            row[what] = f"{worst.error:.2g} of {worst.allowed:.2g}" if worst and worst.allowed else "-"
        row["holds"] = ", ".join(what for what, summary in summaries.items() if not summary.failed)
        row["result"] = "ok"
        if failed := [check for summary in summaries.values() for check in summary.failed]:
            row["result"] = f"{len(failed)} FAILED: {failed[0].what}, {failed[0].case}: {failed[0].message}"
        elif list(summaries) == ["runs"]:
            row |= {"holds": "-", "result": f"not run: {summaries['runs'].worst.message}"}
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


def _print_long_runs(runs: list[LongRun]) -> None:
    print_rows(
        [
            {
                "long run": run.name,
                "dtype": run.dtype,
                "error after frames": ", ".join(
                    f"{number}: {error:.1g}" for number, error in zip(run.frames, run.errors, strict=True)
                )
                or "-",
                "at most": f"{run.allowed:.2g}" if run.allowed else "-",
                "ghost": "-" if run.ghost is None else f"{run.ghost} frames",
                "result": "ok" if run.passed else run.message,
            }
            for run in runs
        ]
    )
