"""`mcdenoise generate`."""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path
from typing import Literal

import tyro
from rich.progress import TaskID

from mcdenoise.cli._options import Out, parse_size
from mcdenoise.cli._output import progress_bar
from mcdenoise.cli.render import RenderOptions
from mcdenoise.data.sequences import parse_frames
from mcdenoise.errors import InputError
from mcdenoise.scenes.cycles import Blender, render_cycles
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
    renderer: Literal["mitsuba", "cycles"] = "mitsuba",
    cycles_spp: int | None = None,
    blender_python: Path | None = None,
    threads: int = 0,
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
        renderer: with cycles, by Blender, each noisy color has features of its own; pixel filter, depth of field and
            motion blur are drawn from the seed.
        cycles_spp: samples a pixel of Cycles' noisy colors; by default drawn from the seed, 1 for half of the scenes.
        blender_python: a Python that has Blender's module bpy; this one by default.
        threads: of Cycles; all processors by default.
    """
    if frames < 1:
        raise InputError(f"--frames: expected at least 1, found {frames}")
    if not 0 < zoom < math.inf:
        raise InputError(f"--zoom: expected a positive number, found {zoom:g}")
    chosen, arguments = parse_frames(seeds, name="--seeds"), rendering.arguments()
    with ExitStack() as stack:
        blender = stack.enter_context(Blender(blender_python)) if renderer == "cycles" else None
        progress = stack.enter_context(progress_bar())
        whole = progress.add_task("scenes", total=len(chosen))
        for seed in chosen:
            made = random_scene(seed, frames, zoom)
            task = progress.add_task(f"random{seed:04d}", total=None)

            def show(done: int, total: int, task: TaskID = task) -> None:
                progress.update(task, completed=done, total=total)

            folder, noise = out / f"random{seed:04d}", seed if noise_seed is None else noise_seed
            if blender is not None:
                written = render_cycles(
                    made,
                    folder,
                    blender,
                    size=parse_size(rendering.size),
                    seed=noise,
                    samples=cycles_spp,
                    realisations=rendering.realisations,
                    reference_samples=rendering.reference_spp,
                    threads=threads,
                    progress=show,
                )
            else:
                written = render_sequence(
                    made.scene, made.cameras, folder, seed=noise, moves=made.moves, progress=show, **arguments
                )
            progress.remove_task(task)
            progress.advance(whole)
            print(written, flush=True)
