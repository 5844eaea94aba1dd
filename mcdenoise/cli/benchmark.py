"""`mcdenoise benchmark`."""

from __future__ import annotations

import os
import shlex
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro

from mcdenoise.benchmark import Settings, benchmark_ops, choose_methods, parse_sizes, run_benchmark
from mcdenoise.benchmark.sizes import SIZES
from mcdenoise.benchmark.tables import op_rows, remarks, scene_rows, skipped_rows
from mcdenoise.check.cases import OPS
from mcdenoise.check.own import find_ops
from mcdenoise.cli._options import Json
from mcdenoise.cli._output import print_rows, progress_bar, say, steps_of, warn, write_json
from mcdenoise.data import open_sequence
from mcdenoise.data.files import write_text
from mcdenoise.errors import InputError
from mcdenoise.heap import keep_heap
from mcdenoise.methods import Spelling
from mcdenoise.models import DEFAULT
from mcdenoise.report import check_packages, write_report, write_sample_plots
from mcdenoise.results import FILE
from mcdenoise.shot import check_threads
from mcdenoise.suite.close_ups import write_close_ups
from mcdenoise.suite.rendering import open_row, render_suite, rows_there
from mcdenoise.suite.rows import choose_rows
from mcdenoise.suite.tables import SHOWN, error_against_time, lines_of, markdown, sample_curves, with_peers


def benchmark(
    sequences: tyro.conf.Positional[list[Path]] = [],  # noqa: B006 - tyro reads it
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = None,
    models: str | None = None,
    precisions: str | None = None,
    frames: str | None = None,
    rounds: int | None = None,
    threads: int | None = None,
    device: str = "cpu",
    sizes: str | None = None,
    pictures: int = 4,
    keep_all: bool = False,
    ops: bool = False,
    suite: Literal["wild"] | None = None,
    data: Path | None = None,
    rows: str | None = None,
    render: bool = True,
    json: Json = None,
) -> int:
    """Measure the error and the run time of methods, which take turns on the same frames.

    Writes the report OUT/index.html with its plots, results.json, results.csv and images; OUT must be new or empty. The
    exit status is 1 if a method failed on a scene; a method is skipped on scenes that lack a buffer it needs. With
    --ops, measures the operators instead: run time, error, and run time relative to a copy. With --out of a finished
    benchmark alone, writes its report again.

    With --suite wild, renders the missing frames of a test suite that no training uses, in Mitsuba and in Blender's
    Cycles, to the folder of --data, and compares --models with OIDN's best setting on each row: OUT/suite.md,
    suite.json and close-ups. The best setting is that of eleven, or of those that --models names. Without --out it only
    renders. Rendering everything takes hours; it can be interrupted, and resumes.

    Args:
        sequences: folders of sequences with references.
        out: new or empty folder for the results; required except with --ops.
        models: methods separated by commas: names of `mcdenoise models`, with optional settings such as
            "oidn(quality=fast|high)"; weights files; file.py:factory; "pretrained" for all models with shipped weights;
            "all" for every model, where those without weights are listed as missing; or "none". By default the models
            with shipped weights, filters, and other denoisers; with --suite, the default of `mcdenoise denoise`. The
            noisy input and accumulation alone are always included.
        precisions: precisions of the convolutions of trainable models: float32,bfloat16 by default, float32
            with --suite.
        frames: frames of each sequence to denoise, such as 0-59,70; all by default.
        rounds: number of timed repetitions of each frame and of each size; 3 by default, 5 with --ops, 1 with --suite.
        threads: number of CPU threads of all methods; torch's default if not given.
        device: cpu or cuda.
        sizes: sizes of synthetic images for measuring run time over pixels, such as 1280x720,3840x2160, or none; five
            by default. With --ops one size, that of the images; 1280x720 by default.
        pictures: number of frames of each scene whose images are stored.
        keep_all: measure each method that skips work a second time without skipping, to see what skipping saves.
        ops: measure operators: those that are named in place of folders, or all.
        suite: render and score the suite of this name.
        data: folder of the suite's frames.
        rows: rows of the suite to score, such as "cycles-*,mitsuba-parlour-box-4"; all by default.
        render: with --no-render, score the rows that exist in the folder of --data, and render nothing.
        json: write the content of results.json, or ops.json, to this file too.
    """
    keep_heap()
    threads = torch.get_num_threads() if threads is None else threads
    check_threads(threads)
    command = _command_line({name: value for name, value in locals().items() if name != "json"})
    rounds = rounds if rounds is not None else 5 if ops else 1 if suite else 3
    settings = Settings(
        rounds=rounds,
        threads=threads,
        device=device,
        sizes=tuple(parse_sizes(sizes if sizes is not None else "1280x720" if ops else SIZES)),
        pictures=pictures,
        command=command,
    )
    if ops and suite is None:
        return _time_ops(sequences, out, settings, json)
    if suite is not None:
        if ops or sequences:
            raise InputError("--suite: expected neither folders of sequences nor --ops with it, found one of them")
        return _score_suite(data, out, settings, rows, models, precisions, render, json)
    if not sequences:
        if out is None or not os.path.exists(out / FILE):
            raise InputError("expected folders of sequences, or --ops, found neither; see `mcdenoise benchmark --help`")
        say(f"report: {write_report(out)}")
        return 0
    if out is None:
        raise InputError("--out: expected a folder to write to, found none; give one with -o")
    check_packages()
    opened = [open_sequence(sequence, frames) for sequence in sequences]
    methods = choose_methods(models, precisions=precisions or "float32,bfloat16", keep_all=keep_all)
    tried = {
        each.model: Spelling(each.model, None, each.settings) for each in methods if not each.weights + each.missing
    }
    warn(*(each.doubt for each in tried.values()))
    with steps_of("benchmark") as on_step:
        results = run_benchmark(opened, methods, out, settings, on_step=on_step)
    print_rows(scene_rows(results))
    print_rows(skipped_rows(results))
    for line in [*remarks(results), f"report: {write_report(out)}"]:
        say(line)
    write_json(json, asdict(results))
    return 1 if results.failed else 0


def _time_ops(names: list[Path], out: Path | None, settings: Settings, json: Json) -> int:
    if len(settings.sizes) != 1:
        raise InputError(f"--sizes: expected one size with --ops, found {len(settings.sizes)}")
    with steps_of("ops") as on_step:
        costs = benchmark_ops(
            size=settings.sizes[0],
            rounds=settings.rounds,
            threads=settings.threads,
            device=settings.device,
            out=out,
            command=settings.command,
            ops=find_ops([str(name) for name in names] or None, OPS),
            on_step=on_step,
        )
    print_rows(op_rows(costs))
    print(f"a copy moves {costs.bandwidth:.1f} GB/s, reading and writing")
    write_json(json, asdict(costs))
    return 0


def _score_suite(
    data: Path | None,
    out: Path | None,
    settings: Settings,
    rows: str | None,
    models: str | None,
    precisions: str | None,
    render: bool,
    json: Path | None,
) -> int:
    """Render missing frames of the suite, score the methods on its rows, and write the tables."""
    if data is None:
        raise InputError("--data: expected the folder of the suite's frames, found none; give one")
    chosen = choose_rows(rows)
    settings = replace(settings, sizes=(), pictures=1, metrics=SHOWN, memory=False)
    if out is None and not render:
        raise InputError("--out: expected a folder to write to with --no-render, found none; give one with -o")
    # Report errors in the choice of methods before hours of rendering.
    named = with_peers(models or DEFAULT)
    methods = choose_methods(named, precisions=precisions or "float32", baselines=("noisy",))
    if out is not None:
        check_packages()
    with progress_bar() as progress:
        task = progress.add_task("render", total=None)

        def show(shot: str, fraction: float, done: int, total: int) -> None:
            described = f"render {shot}, references to {fraction:.0%}"
            progress.update(task, description=described, completed=done, total=total)

        if render:
            wanted = dict.fromkeys(row.shot for row in chosen)
            render_suite(wanted, data, threads=settings.threads, on_step=show)
    if out is None:
        say(data)
        return 0
    found = rows_there(chosen, data)
    if not found:
        raise InputError(f"{data}: expected frames of the suite, found none; omit --no-render to render them")
    missing = [row.name for row in chosen if row not in found]
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


def _command_line(options: dict[str, Any]) -> str:
    """A command line with all options, including those with their default values."""
    words = ["mcdenoise", "benchmark", *map(str, options.pop("sequences"))]
    for name, value in options.items():
        option = name.replace("_", "-")
        if isinstance(value, bool):
            words += [f"--{option}" if value else f"--no-{option}"] if value is not (name == "render") else []
        elif value not in (None, ""):
            words.append(f"--{option}={value}")
    return shlex.join(words)
