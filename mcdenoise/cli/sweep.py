"""`mcdenoise sweep`."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro

from mcdenoise.cli._options import Out
from mcdenoise.cli._output import print_rows, progress_bar, say
from mcdenoise.cli.train import make_data, options_of
from mcdenoise.data.files import held
from mcdenoise.data.sequences import parse_frames
from mcdenoise.engines import Engine, LocalEngine, RayEngine, Task, processors, run_tasks
from mcdenoise.errors import InputError
from mcdenoise.folder import make_folder
from mcdenoise.heap import keep_heap
from mcdenoise.train import Recipe, Run, RunFolder, train


@dataclass(frozen=True)
class _Job:
    """A run of the sweep."""

    run: Run
    out: Path
    sequences: list[Path]
    validation: list[Path]
    cache: Path
    credits: str
    accelerator: str
    checkpoint_every: int
    threads: int


def sweep(
    recipes: tyro.conf.Positional[list[Path]],
    out: Out,
    seeds: str | None = None,
    data: Path | None = None,
    cache: Path | None = None,
    workers: int | None = None,
    ray: str | None = None,
    threads: int | None = None,
    accelerator: str = "cpu",
    checkpoint_every: int = 500,
) -> int | None:
    """Train all runs of some recipes, each with several seeds, side by side: OUT/RECIPE-SEED/.

    The data of all recipes are rendered first, on the same machines. The same command again resumes runs that were
    stopped. The run of a lost worker is retried from its last checkpoint; runs that failed are listed at the end, with
    status 1, and all others are trained.

    Args:
        recipes: TOML files, see `mcdenoise train --recipe`; of one with several runs, each run has a folder of its name
            in OUT/RECIPE-SEED.
        out: folder of the sweep; each run in it has what `mcdenoise train` writes.
        seeds: seeds of the training, such as 1-3,7, instead of those that the recipes name.
        data: folder of the sequences that are rendered; OUT/data by default.
        cache: folder of the decoded sequences; OUT/cache by default.
        workers: processes of this machine; 1 by default.
        ray: address of a Ray cluster that trains instead, such as auto, 10.0.0.1:6379, or local for one on this
            machine; all machines see the same folders.
        threads: processors that a run takes; by default one on a Ray cluster, else those of this machine divided by
            the workers.
        accelerator: cpu or cuda.
        checkpoint_every: steps between checkpoints.
    """
    if ray is not None and workers is not None:
        raise InputError("--workers, --ray: expected one of them, found both")
    workers = 1 if workers is None else workers
    threads = (1 if ray is not None else max(1, processors() // max(workers, 1))) if threads is None else threads
    for name, value in {"--workers": workers, "--threads": threads}.items():
        if value < 1:
            raise InputError(f"{name}: expected at least 1, found {value}")
    # Workers have other working folders.
    out, data, cache = (Path(os.path.abspath(each)) for each in (out, data or out / "data", cache or out / "cache"))
    numbers: list[int] | list[None] = [None] if seeds is None else parse_frames(seeds, name="--seeds")
    options = options_of("generate")
    read = {(path, number): Recipe.read(path, options, number) for path in recipes for number in numbers}
    places = {key: out / (key[0].stem if key[1] is None else f"{key[0].stem}-{key[1]}") for key in read}
    _check_places(places, out)
    for key, recipe in read.items():
        for run in recipe.runs:
            RunFolder(places[key] / run.name).check(config=dataclasses.asdict(run.config))
    make_folder(out)
    with held(out, "sweep"):
        made = {path: make_data(read[path, numbers[0]], data, ray) for path in recipes}
        jobs = [
            _Job(
                run,
                places[path, number] / run.name,
                *made[path],
                cache,
                recipe.credits,
                accelerator,
                checkpoint_every,
                threads,
            )
            for (path, number), recipe in read.items()
            for run in recipe.runs
        ]
        engine: Engine
        if ray is None:
            engine = LocalEngine(workers)
        else:
            engine = RayEngine(ray, cpus=threads, gpus=float(accelerator == "cuda"))
        return _train(jobs, engine, out)


def _train(jobs: list[_Job], engine: Engine, out: Path) -> int | None:
    expected = {str(job.out.relative_to(out)): job.run.expected for job in jobs}
    with progress_bar() as progress:
        bar = progress.add_task("runs", total=len(jobs))

        def done(task: Task, errors: Mapping[str, float]) -> None:
            progress.advance(bar)
            say(f"  {task.name}:{''.join(f'  {name} {value:.4f}' for name, value in errors.items())}")
            results[task.name] = errors

        results: dict[str, Mapping[str, float]] = {}
        tasks = [
            Task(name, train_task, (job,), RunFolder(job.out).checkpointed)
            for name, job in zip(expected, jobs, strict=True)
        ]
        failed = run_tasks(engine, tasks, done)
    print_rows([_row(name, results.get(name, {}), bound, failed) for name, bound in expected.items()])
    say(f"{len(results)} of {len(jobs)} runs trained: {out}")
    return 1 if failed else None


def _row(
    name: str, errors: Mapping[str, float], expected: tuple[float, float] | None, failed: Mapping[str, str]
) -> dict[str, str]:
    smape = errors.get("smape", math.nan)
    bound = "" if expected is None else f"{expected[0]:g} + {expected[1]:g}"
    return {
        "run": name,
        "smape": "" if math.isnan(smape) else f"{smape:.4f}",
        "expected": bound,
        "": failed.get(name) or ("" if expected is None else "met" if smape <= sum(expected) else "missed"),
    }


def train_task(job: _Job) -> dict[str, float]:
    """A task: train a run, or resume it.

    Returns:
        The errors of the last validation, by name.

    Raises:
        InputError: see :func:`mcdenoise.train.train`.
    """
    keep_heap()
    torch.set_num_threads(job.threads)
    train(
        job.run.config,
        job.sequences,
        job.out,
        validation=job.validation,
        cache=job.cache,
        accelerator=job.accelerator,
        checkpoint_every=job.checkpoint_every,
        credits=job.credits,
        recipe=job.run.sha256,
    )
    return RunFolder(job.out).errors()


def _check_places(places: Mapping[Any, Path], out: Path) -> None:
    """See that no two recipes have one folder, and none has that of the data."""
    taken = {out / "data", out / "cache"}
    for (path, _), place in places.items():
        if place in taken:
            raise InputError(f"{path}: expected a name of its own for each recipe, found {place.name} again; rename it")
        taken.add(place)
