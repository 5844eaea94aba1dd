"""`mcdenoise benchmark`."""

from __future__ import annotations

import shlex
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro

from mcdenoise.benchmark import Settings, benchmark_ops, choose_methods, parse_sizes, run_benchmark
from mcdenoise.benchmark.sizes import SIZES
from mcdenoise.benchmark.tables import op_rows, remarks, scene_rows, skipped_rows
from mcdenoise.cli._options import Json, parse_size
from mcdenoise.cli._output import print_rows, progress_bar, say, write_json
from mcdenoise.cli._suite import SHOWN, score_suite
from mcdenoise.data import open_sequence
from mcdenoise.errors import InputError
from mcdenoise.heap import keep_heap
from mcdenoise.report import check_packages, write_report
from mcdenoise.shot import check_threads


def benchmark(
    sequences: tyro.conf.Positional[list[Path]] = [],  # noqa: B006 - tyro reads it
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = None,
    models: str | None = None,
    precisions: str = "float32,bfloat16",
    frames: str | None = None,
    rounds: int | None = None,
    threads: int | None = None,
    busy: int = 0,
    device: str = "cpu",
    sizes: str = SIZES,
    pictures: int = 4,
    keep_all: bool = False,
    ops: bool = False,
    size: str = "1280x720",
    suite: Literal["wild"] | None = None,
    data: Path | None = None,
    rows: str | None = None,
    blender_python: Path | None = None,
    render: bool = True,
    json: Json = None,
) -> int:
    """Measure error against run time of methods, baselines included, on the same frames, interleaved.

    Writes OUT/index.html, the report, with its plots, results.json, results.csv and images; OUT must not exist.
    Exit status 1 if a method failed on a scene; a method is skipped on a scene that lacks a buffer it needs.
    With --ops, measures the operators instead: run time, error, and run time relative to a copy.

    With --suite wild, renders frames that no training uses, by Mitsuba and by Blender's Cycles, to the folder of --data
    if they are missing, and compares --models with OIDN's best setting for each: OUT/suite.md, suite.json and
    close-ups. Without --out it only renders. Rendering everything takes hours; it can be interrupted and resumes.

    Args:
        sequences: folders of sequences with references.
        out: folder to create; required except with --ops.
        models: names separated by commas, see `mcdenoise models`, optionally with settings, several at once such as
            "oidn(quality=fast|high)"; weights files; file.py:factory; "pretrained" for all with shipped weights; "all"
            for every model, including those without weights, which are listed as missing; or none. By default those
            with shipped weights, filters, and other denoisers. The noisy input and accumulation alone are always
            included.
        precisions: precisions of the convolutions of trained models: float32, bfloat16, and int8 if calibrated.
        frames: frames of each sequence to denoise, such as 0-59,70; all by default.
        rounds: number of times that each method denoises each frame, and each size; 3 by default, 5 with --ops.
        threads: CPU threads of all methods; torch's choice by default.
        busy: number of cores that other processes keep busy while times are measured, to simulate a renderer.
        device: cpu or cuda.
        sizes: sizes of synthetic images for measuring run times only, such as 1280x720,3840x2160, or none.
        pictures: number of frames of each scene whose images are kept.
        keep_all: measure each method that skips anything again without skipping, to see what skipping saves.
        ops: measure the operators.
        size: size of the images with --ops, WIDTHxHEIGHT.
        suite: render and score the suite of this name.
        data: folder of the suite's frames.
        rows: rows of the suite to score, such as "cycles-*,mitsuba-parlour-box-4"; all by default.
        blender_python: a Python with Blender's module bpy, for rendering the suite's rows of Cycles; by default that of
            the environment variable BLENDER_PYTHON, or else this one.
        render: --no-render uses the rows that are in the folder of --data and renders nothing.
        json: also write the contents of results.json, or ops.json, to this file.
    """
    keep_heap()
    threads = torch.get_num_threads() if threads is None else threads
    check_threads(threads)
    if suite is not None:
        if ops or sequences:
            raise InputError("--suite: expected neither folders of sequences nor --ops beside it, found one")
        if data is None:
            raise InputError("--data: expected the folder of the suite's frames, found none; give one")
        command = _command_line("benchmark", suite=suite, data=data, rows=rows, models=models, threads=threads, out=out)
        settings = Settings(
            rounds=1 if rounds is None else rounds,
            threads=threads,
            device=device,
            pictures=1,
            metrics=SHOWN,
            memory=False,
            command=command,
        )
        return score_suite(data, out, settings, rows, models, blender_python, render=render, json=json)
    if ops == bool(sequences):
        raise InputError("expected the folders of sequences, or --ops, and not both; see `mcdenoise benchmark --help`")
    rounds = rounds if rounds is not None else 5 if ops else 3
    if ops:
        with progress_bar() as progress:
            task = progress.add_task("ops", total=None)
            costs = benchmark_ops(
                size=parse_size(size),
                rounds=rounds,
                threads=threads,
                device=device,
                out=out,
                command=_command_line(
                    "benchmark", "--ops", out=out, size=size, rounds=rounds, threads=threads, device=device
                ),
                on_step=lambda done, total: progress.update(task, completed=done, total=total),
            )
        print_rows(op_rows(costs))
        print(f"a copy moves {costs.bandwidth:.1f} GB/s, read and written")
        write_json(json, asdict(costs))
        return 0
    if out is None:
        raise InputError("--out: expected a folder to write to, found none; give one with -o")
    if rounds < 1:
        raise InputError(f"--rounds: expected at least 1, found {rounds}")
    settings = Settings(
        rounds=rounds,
        threads=threads,
        busy=busy,
        device=device,
        sizes=tuple(parse_sizes(sizes)),
        pictures=pictures,
        command=_command_line(
            "benchmark",
            *sequences,
            *(["--keep-all"] if keep_all else []),
            out=out,
            models=models,
            precisions=precisions,
            frames=frames,
            rounds=rounds,
            threads=threads,
            busy=busy or None,
            device=device,
            sizes=sizes,
            pictures=pictures,
        ),
    )
    check_packages()
    opened = [open_sequence(sequence, frames) for sequence in sequences]
    methods = choose_methods(models, precisions=precisions, keep_all=keep_all)
    with progress_bar() as progress:
        task = progress.add_task("benchmark", total=None)
        results = run_benchmark(
            opened,
            methods,
            out,
            settings,
            on_step=lambda done, total: progress.update(task, completed=done, total=total),
        )
    print_rows(scene_rows(results))
    print_rows(skipped_rows(results))
    for line in [*remarks(results), f"report: {write_report(out)}"]:
        say(line)
    write_json(json, asdict(results))
    return 1 if results.failed else 0


def _command_line(*arguments: object, **options: object) -> str:
    """A command line with all options, including default values."""
    chosen = [f"--{name}={value}" for name, value in options.items() if value is not None]
    return shlex.join(["mcdenoise", *map(str, arguments), *chosen])
