"""`mcdenoise stability`."""

from __future__ import annotations

import tyro
from rich.markup import escape
from rich.table import Table

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
from mcdenoise.cli._output import progress_bar, show, write_json
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
    if not checks:
        return
    rows: dict[tuple[str, str, str], list[Summary]] = {}
    for summary in summarize(checks):
        rows.setdefault((summary.subject, summary.dtype, summary.backend), []).append(summary)
    table = Table("subject", "dtype", "backend", "checks", "condition", "forward", "gradient", "holds", "result")
    for key, summaries in rows.items():
        found = {summary.what: summary for summary in summaries}
        errors = []
        for what in ("forward", "gradient"):
            worst = found[what].worst if what in found else None
            errors.append(f"{worst.error:.2g} of {worst.allowed:.2g}" if worst and worst.allowed else "-")
        holds = ", ".join(what for what, summary in found.items() if not summary.failed)
        failed = [check for summary in summaries for check in summary.failed]
        result = "ok"
        if failed:
            result = f"{len(failed)} FAILED: {failed[0].what}, {failed[0].case}: {failed[0].message}"
        elif list(found) == ["runs"]:
            holds, result = "-", f"not run: {found['runs'].worst.message}"
        condition = max(summary.condition for summary in summaries)
        # Names and messages of other people's code are not markup.
        row = (*key, str(sum(s.checks for s in summaries)), f"{condition:.1g}", *errors, holds, result)
        table.add_row(*map(escape, row))
    show(table)


def _print_shots(checks: list[Check]) -> None:
    """Print a row for each unusual shot: how many denoisers and dtypes had a valid image, and which had none."""
    rows: dict[str, list[Check]] = {}
    for check in checks:
        if check.what == VALID_SHOT:
            rows.setdefault(check.case, []).append(check)
    if not rows:
        return
    table = Table("shot", "checks", "every image is finite and not negative")
    for case, found in rows.items():
        failed = [f"{check.subject}, {check.dtype}: {check.message}" for check in found if not check.passed]
        table.add_row(*map(escape, (case, str(len(found)), f"FAILED: {failed[0]}" if failed else "ok")))
    show(table)


def _print_long_runs(runs: list[LongRun]) -> None:
    if not runs:
        return
    table = Table("long run", "dtype", "error after frames", "at most", "ghost", "result")
    for run in runs:
        over_time = ", ".join(f"{number}: {error:.1g}" for number, error in zip(run.frames, run.errors, strict=True))
        ghost = "-" if run.ghost is None else f"{run.ghost} frames"
        allowed = f"{run.allowed:.2g}" if run.allowed else "-"
        table.add_row(run.name, run.dtype, over_time or "-", allowed, ghost, "ok" if run.passed else run.message)
    show(table)
