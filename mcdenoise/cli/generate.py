"""`mcdenoise generate`."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Literal

import tyro

from mcdenoise.cli._options import Flag, Out, parse_size
from mcdenoise.cli._output import print_rows, progress_bar, say, warn
from mcdenoise.cli.render import RenderOptions
from mcdenoise.data.sequences import parse_frames
from mcdenoise.engines import RayEngine, Task, parse_workers, run_tasks
from mcdenoise.errors import InputError
from mcdenoise.scenes.assets import default_folder, open_assets
from mcdenoise.scenes.cycles import Blender
from mcdenoise.scenes.generation import Generation, render_seed
from mcdenoise.scenes.random.takes import Sampling
from mcdenoise.scenes.render import choose_variant
from mcdenoise.scenes.takes import TakePlan, render_takes
from mcdenoise.scenes.takes.draw import FRAMES
from mcdenoise.scenes.takes.tracing import HALF

_FOR_TRAINING = RenderOptions(noise_seeds=3, reference_spp=64, size="160x160")
_WILD_STILLS = 0.5
_FRAMES = 12


def generate(
    out: Out,
    rendering: tyro.conf.OmitArgPrefixes[RenderOptions] = _FOR_TRAINING,
    seeds: str = "0-15",
    frames: int = _FRAMES,
    wild: bool = False,
    sampling: Sampling | None = None,
    stills: float | None = None,
    renderer: Literal["mitsuba", "cycles"] = "mitsuba",
    cycles_spp: int | None = None,
    parts: Flag = False,
    threads: int = 0,
    takes: Flag = False,
    assets: Path | None = None,
    unseen: Flag = False,
) -> int | None:
    """Render random rooms, courts and still lifes to sequences to train on: OUT/random0000, OUT/random0001, ...

    The same seed is the same scene and noise anywhere. The same command again resumes a run that was stopped. On a
    cluster, each seed is a task: the task of a lost worker is retried, and seeds that failed are listed at the end,
    with status 1.

    Args:
        out: folder of the sequences; finished frames in it are kept.
        rendering: samples, references, size and processors.
        seeds: seeds of the scenes, such as 0-99,200.
        frames: frames of each sequence; with --takes 16 by default.
        wild: frames as renderers' users have them: coats, mirrors, glass and metal in every scene, --sampling mixed,
            --stills 0.5, and for each sequence its own number of samples, from 1 to 64 instead of --spp.
        sampling: every sample at the pixel centre, with features without noise (centre, the default); or as Mitsuba
            takes them, through a pixel filter and at times a lens, with features of the same samples (filtered); or
            for each sequence one of both (mixed).
        stills: fraction of the scenes of which half as many stills are rendered as a clip has frames, each a sequence
            of its own, OUT/random0000_0, OUT/random0000_1, ...
        renderer: with cycles, by Blender, each noisy color has features of its own; pixel filter, depth of field and
            motion blur are drawn from the seed. A Python that has Blender's module bpy is named by the environment
            variable BLENDER_PYTHON, or else is this one.
        cycles_spp: samples a pixel of Cycles' noisy colors; by default drawn from the seed, 1 for half of the scenes.
        parts: with Cycles, also write diffuse and specular light, which add up to each noisy color.
        threads: threads of Cycles and of --takes; all processors by default. On a cluster, the processors that a
            task takes; 1 by default.
        takes: packed takes instead of sequences, OUT/000000.take.npz, ..., of furnished rooms, desks, streets, pools
            and things before nothing. --seeds are their numbers. A third are stills, the others have 16 frames with
            references on the last three. Pixel filter, lens, features and samples are drawn, too. The only other
            options that count are --frames, --size, --reference-spp (from 2 on), --variant and --threads.
        assets: folder of the models, skies and normal maps of --takes, which are fetched to it; by default in the
            user's cache.
        unseen: make takes of the tenth of the assets that no other take has, to measure on.
    """
    if takes:
        _make_takes(out, rendering, seeds, frames, threads, assets or default_folder(), unseen)
        return None
    if unseen or assets is not None:
        raise InputError("--assets, --unseen: expected together with --takes, found alone")
    if frames < 1:
        raise InputError(f"--frames: expected at least 1, found {frames}")
    if stills is not None and not 0 <= stills <= 1:
        raise InputError(f"--stills: expected a fraction from 0 to 1, found {stills:g}")
    if parts and renderer != "cycles":
        raise InputError("--parts: expected together with --renderer cycles: Mitsuba's path integrator has no parts")
    chosen, workers = parse_frames(seeds, name="--seeds"), parse_workers(rendering.workers)
    arguments = {**rendering.arguments(), "workers": workers or 1}
    cycles = renderer == "cycles"
    plan = Generation(
        out=Path(os.path.abspath(out)),
        rendering=arguments,
        frames=frames,
        wild=wild,
        sampling=sampling or ("mixed" if wild else "centre"),
        stills=(_WILD_STILLS if wild else 0) if stills is None else stills,
        cycles=cycles,
        cycles_spp=cycles_spp,
        parts=parts,
        threads=threads,
    )
    if workers is None:
        return _on_ray(plan, chosen, rendering.workers, out)
    with ExitStack() as stack:
        blender = stack.enter_context(Blender()) if cycles else None
        progress = stack.enter_context(progress_bar())
        scenes = progress.add_task("scenes", total=len(chosen))

        def begin(name: str) -> Callable[[int, int], None]:
            task = progress.add_task(name, total=None)

            def show(done: int, total: int) -> None:
                progress.update(task, completed=done, total=total, visible=done < total)

            return show

        for seed in chosen:
            for written in plan.render(seed, blender, begin):
                say(written)
            progress.advance(scenes)
    return None


def _make_takes(
    out: Path, rendering: RenderOptions, seeds: str, frames: int, threads: int, assets: Path, unseen: bool
) -> None:
    """Render packed takes; options that have the defaults of sequences have those of takes."""
    given = {name: value for name, value in vars(rendering).items() if value != getattr(_FOR_TRAINING, name)}
    others = given.keys() - {"size", "reference_spp", "variant"}
    if others:
        raise InputError(f"--{min(others).replace('_', '-')}: expected none beside --takes, which draws it, found one")
    if rendering.reference_spp < 2 or frames < 1:
        raise InputError("--reference-spp, --frames: expected at least 2 samples and 1 frame for --takes")
    numbers = parse_frames(seeds, name="--seeds")
    plan = TakePlan(
        out=out,
        assets=open_assets(assets, lambda line: warn([line])),
        unseen=unseen,
        variant=choose_variant(rendering.variant),
        threads=threads,
        frames=FRAMES if frames == _FRAMES else frames,
        size=parse_size(rendering.size) if "size" in given else None,
        half=rendering.reference_spp // 2 if "reference_spp" in given else HALF,
    )
    with progress_bar() as progress:
        task = progress.add_task("takes", total=len(numbers))
        for written in render_takes(plan, numbers):
            say(written)
            progress.advance(task)


def _on_ray(plan: Generation, seeds: list[int], address: str, out: Path) -> int | None:
    """Render the seeds on a Ray cluster, a task each."""
    threads = plan.threads or 1
    # One variant for all machines, because it is part of the identity of a sequence.
    variant = "" if plan.cycles else choose_variant(plan.rendering["variant"])
    plan = replace(plan, threads=threads, rendering={**plan.rendering, "variant": variant or None})
    engine = RayEngine(address, cpus=threads, gpus=float(variant.startswith("cuda")))
    with progress_bar() as progress:
        scenes = progress.add_task("scenes", total=len(seeds))

        failed: list[dict[str, str]] = []

        def task(seed: int) -> Task:
            def done(written: list[Path]) -> list[Task]:
                progress.advance(scenes)
                for each in written:
                    say(out / each.relative_to(plan.out))
                return []

            def fail(reason: str) -> list[Task]:
                failed.append({"scene": f"seed {seed}", "failed": reason})
                return []

            return Task(render_seed, (plan, seed), done, fail)

        run_tasks(engine, map(task, seeds))
    print_rows(failed)
    return 1 if failed else None
