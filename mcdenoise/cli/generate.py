"""`mcdenoise generate`."""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path
from typing import Literal

import tyro
from rich.progress import TaskID

from mcdenoise.cli._options import Flag, Out
from mcdenoise.cli._output import progress_bar, say
from mcdenoise.cli.render import RenderOptions
from mcdenoise.data.sequences import parse_frames
from mcdenoise.errors import InputError
from mcdenoise.scenes.cycles import Blender, render_cycles
from mcdenoise.scenes.random.takes import CLEANER, Sampling, random_takes
from mcdenoise.scenes.render import render_sequence

_FOR_TRAINING = RenderOptions(realisations=3, reference_spp=64, size="160x160")
_WILD_STILLS = 0.5


def generate(
    out: Out,
    rendering: tyro.conf.OmitArgPrefixes[RenderOptions] = _FOR_TRAINING,
    seeds: str = "0-15",
    frames: int = 12,
    zoom: float = 1.0,
    noise_seed: int | None = None,
    wild: bool = False,
    sampling: Sampling | None = None,
    stills: float | None = None,
    renderer: Literal["mitsuba", "cycles"] = "mitsuba",
    cycles_spp: int | None = None,
    blender_python: Path | None = None,
    parts: Flag = False,
    threads: int = 0,
) -> None:
    """Render random rooms, courts and still lifes to sequences to train on: OUT/random0000, OUT/random0001, ...

    The same seed is the same scene and noise anywhere. The same command again resumes a run that was stopped.

    Args:
        out: folder of the sequences; finished frames in it are kept.
        rendering: samples, references, size and processors.
        seeds: seeds of the scenes, such as 0-99,200.
        frames: frames of each sequence.
        zoom: render the middle of an image that is so many times as wide and high.
        noise_seed: seed of the noise of all scenes; by default each scene takes its own seed.
        wild: frames as renderers' users have them: coats, mirrors, glass and metal in every scene, --sampling mixed,
            --stills 0.5, and for each sequence its own number of samples, from 1 to 64 instead of --spp.
        sampling: every sample at the pixel centre, with features without noise (centre, the default); or as Mitsuba
            takes them, through a pixel filter and at times a lens, with features of the same samples (filtered); or
            for each sequence one of both (mixed).
        stills: fraction of the scenes of which half as many stills are rendered as a clip has frames, each a sequence
            of its own, OUT/random0000_0, OUT/random0000_1, ...
        renderer: with cycles, by Blender, each noisy color has features of its own; pixel filter, depth of field and
            motion blur are drawn from the seed.
        cycles_spp: samples a pixel of Cycles' noisy colors; by default drawn from the seed, 1 for half of the scenes.
        blender_python: a Python that has Blender's module bpy; by default that of the environment variable
            BLENDER_PYTHON, or else this one.
        parts: with Cycles, also write diffuse and specular light, which add up to each noisy color.
        threads: threads of Cycles; all processors by default.
    """
    if frames < 1:
        raise InputError(f"--frames: expected at least 1, found {frames}")
    if not 0 < zoom < math.inf:
        raise InputError(f"--zoom: expected a positive number, found {zoom:g}")
    if stills is not None and not 0 <= stills <= 1:
        raise InputError(f"--stills: expected a fraction from 0 to 1, found {stills:g}")
    if parts and renderer != "cycles":
        raise InputError("--parts: expected together with --renderer cycles: Mitsuba's path integrator has no parts")
    if rendering.keep_samples and renderer == "cycles":
        raise InputError("--keep-samples: expected together with --renderer mitsuba: Cycles writes no single samples")
    chosen, arguments = parse_frames(seeds, name="--seeds"), rendering.arguments()
    with ExitStack() as stack:
        blender = stack.enter_context(Blender(blender_python)) if renderer == "cycles" else None
        progress = stack.enter_context(progress_bar())
        whole = progress.add_task("scenes", total=len(chosen))
        for seed in chosen:
            takes = random_takes(
                seed,
                frames,
                zoom,
                sampling=sampling or ("mixed" if wild else "centre"),
                spp=None if wild else rendering.spp,
                stills=(_WILD_STILLS if wild else 0) if stills is None else stills,
                shiny=wild,
                width=max(arguments["size"][0], 1),
            )
            for take in takes:
                task = progress.add_task(take.name, total=None)

                def show(done: int, total: int, task: TaskID = task) -> None:
                    progress.update(task, completed=done, total=total)

                folder, noise = out / take.name, seed if noise_seed is None else noise_seed
                if blender is not None:
                    written = render_cycles(
                        take.made,
                        folder,
                        blender,
                        size=arguments["size"],
                        seed=noise,
                        view=take.view,
                        samples=cycles_spp,
                        realisations=rendering.realisations,
                        reference_samples=rendering.reference_spp,
                        parts=parts,
                        threads=threads,
                        progress=show,
                    )
                else:
                    reference_spp = max(arguments["reference_spp"], CLEANER * take.spp if wild else 0)
                    written = render_sequence(
                        take.made.scene,
                        take.made.cameras,
                        folder,
                        seed=noise,
                        moves=take.made.moves,
                        film=take.film,
                        progress=show,
                        **{**arguments, "spp": take.spp, "reference_spp": reference_spp},
                    )
                progress.remove_task(task)
                say(written)
            progress.advance(whole)
