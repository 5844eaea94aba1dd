"""`mcdenoise benchmark --suite`: renders missing frames, scores the methods, writes the tables."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

from mcdenoise.benchmark import Settings, choose_methods, run_benchmark
from mcdenoise.benchmark.tables import remarks
from mcdenoise.cli._output import progress_bar, say, steps_of, write_json
from mcdenoise.data.files import write_text
from mcdenoise.errors import InputError
from mcdenoise.models import DEFAULT
from mcdenoise.report import check_packages, write_report, write_sample_plots
from mcdenoise.suite import (
    SHOWN,
    choose_rows,
    error_against_time,
    lines_of,
    markdown,
    open_row,
    render_suite,
    rows_there,
    sample_curves,
    with_peers,
    write_close_ups,
)


def score_suite(
    data: Path,
    out: Path | None,
    settings: Settings,
    patterns: str | None,
    models: str | None,
    precisions: str,
    *,
    render: bool,
    json: Path | None,
) -> int:
    """See :func:`mcdenoise.cli.benchmark.benchmark`; exit status 1 if a method failed on a row."""
    rows = choose_rows(patterns)
    settings = replace(settings, sizes=(), pictures=1, metrics=SHOWN, memory=False)
    if out is None and not render:
        raise InputError("--out: expected a folder to write to with --no-render, found none; give one with -o")
    # Report errors in the choice of methods before hours of rendering.
    named = with_peers(models or DEFAULT)
    methods = choose_methods(named, precisions=precisions, baselines=("noisy",))
    if out is not None:
        check_packages()
    with progress_bar() as progress:
        task = progress.add_task("render", total=None)

        def show(shot: str, fraction: float, done: int, total: int) -> None:
            described = f"render {shot}, references to {fraction:.0%}"
            progress.update(task, description=described, completed=done, total=total)

        if render:
            wanted = dict.fromkeys(row.shot for row in rows)
            render_suite(wanted, data, threads=settings.threads, on_step=show)
    if out is None:
        say(data)
        return 0
    found = rows_there(rows, data)
    if not found:
        raise InputError(f"{data}: expected frames of the suite, found none; omit --no-render to render them")
    missing = [row.name for row in rows if row not in found]
    with steps_of("score") as on_step:
        shots = [open_row(row, data) for row in found]
        results = run_benchmark(shots, methods, out, settings, on_step=on_step)
    lines, curves = lines_of(results, found), lines_of(results, found, curve=True)
    ours = dict.fromkeys(line.model for line in lines)
    text = markdown(lines, curves, *error_against_time(results, found))
    write_text(out / "suite.md", text)
    content = {"lines": [asdict(line) for line in lines], "curves": [asdict(line) for line in curves]}
    write_json(out / "suite.json", content)
    write_json(json, content)
    write_sample_plots(sample_curves(curves), out)
    best = {line.best["SMAPE"].setting: None for line in lines if line.best}
    write_close_ups(out, results, found, ["noisy", *ours, *best])
    print(text)
    for line in [*remarks(results), *([f"not rendered: {', '.join(missing)}"] if missing else [])]:
        say(line)
    say(f"tables: {out / 'suite.md'}, close-ups: {out / 'close-ups'}, report: {write_report(out)}")
    return 1 if results.failed else 0
