"""`mcdenoise generate`."""

from __future__ import annotations

import math

import tyro
from rich.progress import TaskID

from mcdenoise.cli._options import Out
from mcdenoise.cli._output import progress_bar
from mcdenoise.cli.render import RenderOptions
from mcdenoise.data.sequences import parse_frames
from mcdenoise.errors import InputError
from mcdenoise.scenes.random import random_scene
from mcdenoise.scenes.render import render_sequence

_FOR_TRAINING = RenderOptions(realisations=3, reference_spp=64, size="160x160")


def generate(
    out: Out,
    rendering: tyro.conf.OmitArgPrefixes[RenderOptions] = _FOR_TRAINING,
    seeds: str = "0-15",
    frames: int = 12,
    zoom: float = 1.0,
    noise_seed: int | None = None,
) -> None:
    """Render random rooms, courts and still lifes to sequences to train on: OUT/random0000, OUT/random0001, ...

    The same seed is the same scene and noise anywhere. The same command again resumes a run that was stopped.

    Args:
        out: folder of the sequences; finished frames in it are kept.
        rendering: samples, references, size and processors.
        seeds: which scenes, such as 0-99,200.
        frames: frames of each sequence.
        zoom: render the middle of an image that is so many times as wide and high.
        noise_seed: of the noise of all scenes; by default each has the noise of its own seed.
    """
    if frames < 1:
        raise InputError(f"--frames: expected at least 1, found {frames}")
    if not 0 < zoom < math.inf:
        raise InputError(f"--zoom: expected a positive number, found {zoom:g}")
    chosen, arguments = parse_frames(seeds, name="--seeds"), rendering.arguments()
    with progress_bar() as progress:
        whole = progress.add_task("scenes", total=len(chosen))
        for seed in chosen:
            made = random_scene(seed, frames, zoom)
            task = progress.add_task(f"random{seed:04d}", total=None)

            def show(done: int, total: int, task: TaskID = task) -> None:
                progress.update(task, completed=done, total=total)

            written = render_sequence(
                made.scene,
                made.cameras,
                out / f"random{seed:04d}",
                seed=seed if noise_seed is None else noise_seed,
                moves=made.moves,
                progress=show,
                **arguments,
            )
            progress.remove_task(task)
            progress.advance(whole)
            print(written, flush=True)
