"""`mcdenoise generate`."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import tyro

from mcdenoise.cli._options import Flag, Out, parse_size
from mcdenoise.cli._output import print_rows, progress_bar, say, warn
from mcdenoise.cli.render import RenderOptions
from mcdenoise.data.sequences import parse_frames
from mcdenoise.engines import RayEngine, parse_workers, run_each
from mcdenoise.errors import InputError
from mcdenoise.scenes.assets import Assets, open_assets
from mcdenoise.scenes.generation import Plan, SequencePlan, TakePlan
from mcdenoise.scenes.render import choose_variant
from mcdenoise.scenes.takes.tracing import stratified

_FOR_TRAINING = RenderOptions(noise_seeds=3, reference_spp=64, size="160x160")
_FRAMES = 12


def generate(
    out: Out,
    rendering: tyro.conf.OmitArgPrefixes[RenderOptions] = _FOR_TRAINING,
    seeds: str = "0-15",
    frames: int | None = None,
    renderer: Literal["mitsuba", "cycles"] = "mitsuba",
    parts: Flag = False,
    threads: int = 0,
    takes: Flag = False,
    plain: Flag = False,
    assets: str | None = None,
    unseen: Flag = False,
) -> int | None:
    """Render furnished rooms, desks, streets, pools and things before nothing to train on: OUT/random0000, ...

    The same seed is the same scene and noise anywhere. The same command again resumes a run that was stopped. On a
    cluster, each seed is a task: the task of a lost worker is retried, and seeds that failed are listed at the end,
    with status 1.

    Args:
        out: folder of the sequences; finished frames in it are kept.
        rendering: samples, references, size and processors.
        seeds: seeds of the scenes, such as 0-99,200.
        frames: frames of each sequence; 12 by default, with --takes 16.
        renderer: mitsuba samples pixel centres, with features without noise. With cycles, by Blender, each noisy color
            has features of its own; pixel filter, depth of field and motion blur are drawn from the seed. A Python that
            has Blender's module bpy is named by the environment variable BLENDER_PYTHON, or else is this one.
        parts: with Cycles, also write diffuse and specular light, which add up to each noisy color.
        threads: threads of Cycles and of --takes; all processors by default. On a cluster, the processors that a
            task takes; 1 by default.
        takes: packed takes instead of sequences, OUT/000000.take.npz, ... --seeds are their numbers. A third are
            stills, the others have 16 frames with references on the last three. Pixel filter, lens, features and
            samples are drawn, too. The only other options that count are --plain, --frames, --size, --reference-spp
            (from 2 on; rounded up to a number that can be stratified), --variant, --threads and the address of a
            cluster; a size of 160x160 and 64 samples, which sequences have by default, count as not given.
        plain: takes of one sample at pixel centres, with features without noise, as most papers of interactive
            denoising have them; no stills.
        assets: folder of the models, skies and normal maps, which are fetched to it; by default in the user's cache.
            With none, all objects are procedural.
        unseen: make scenes of the tenth of the assets that no other scene has, to measure on.
    """
    if parts and renderer != "cycles":
        raise InputError("--parts: expected together with --renderer cycles: Mitsuba's path integrator has no parts")
    if frames is not None and frames < 1:
        raise InputError(f"--frames: expected at least 1, found {frames}")
    if plain and not takes:
        raise InputError("--plain: expected together with --takes: the other sequences of Mitsuba are plain")
    if takes and renderer == "cycles":
        raise InputError("--takes: expected --renderer mitsuba, found cycles")
    chosen, workers = parse_frames(seeds, name="--seeds"), parse_workers(rendering.workers)
    arguments = rendering.arguments()
    # One variant for all machines, because it is part of the identity of a sequence.
    variant = None if renderer == "cycles" else choose_variant(rendering.variant)
    common: dict[str, Any] = {
        "out": Path(os.path.abspath(out)),
        "threads": threads or int(workers is None),
        "assets": Assets() if assets == "none" else open_assets(Path(assets) if assets else None, warn),
        "unseen": unseen,
    }
    plan: Plan
    if takes:
        plan = TakePlan(**common, variant=str(variant), plain=plain, **_of_takes(rendering, frames))
    else:
        common |= {"frames": frames or _FRAMES, "rendering": {**arguments, "variant": variant}}
        plan = SequencePlan(**common, cycles=renderer == "cycles", parts=parts)
    with progress_bar() as progress:
        scenes = progress.add_task("takes" if takes else "scenes", total=len(chosen))

        def finish(call: tuple[Plan, int], written: Path) -> None:
            progress.advance(scenes)
            say(out / written.relative_to(call[0].out))

        def begin(name: str) -> Callable[[int, int], None]:
            task = progress.add_task(name, total=None)

            def show(done: int, total: int) -> None:
                progress.update(task, completed=done, total=total, visible=done < total)

            return show

        if workers is not None:
            for seed in chosen:
                finish((plan, seed), plan.render(seed, None if takes else begin(f"scene {seed}")))
            return None
        engine = RayEngine(rendering.workers, cpus=plan.threads, gpus=float(str(variant).startswith("cuda")))
        failed = run_each(engine, type(plan).render, [(plan, seed) for seed in chosen], finish)
    print_rows([{"scene": f"seed {seed}", "failed": reason} for (_, seed), reason in failed])
    return 1 if failed else None


def _of_takes(rendering: RenderOptions, frames: int | None) -> dict[str, Any]:
    """How packed takes are rendered; options that have the defaults of sequences have those of takes."""
    given = {name: value for name, value in vars(rendering).items() if value != getattr(_FOR_TRAINING, name)}
    others = given.keys() - {"size", "reference_spp", "variant", "workers"}
    if others:
        raise InputError(f"--{min(others).replace('_', '-')}: expected none beside --takes, which draws it, found one")
    if rendering.reference_spp < 2:
        raise InputError(f"--reference-spp: expected at least 2 for --takes, found {rendering.reference_spp}")
    return {
        **({} if frames is None else {"frames": frames}),
        **({"size": parse_size(rendering.size)} if "size" in given else {}),
        **({"half": stratified(rendering.reference_spp // 2)} if "reference_spp" in given else {}),
    }
