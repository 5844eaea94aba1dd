"""`mcdenoise film`."""

from __future__ import annotations

import time
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import torch
import tyro

from mcdenoise.cli._options import Out, Workers
from mcdenoise.cli._output import print_rows, progress_bar, say, warn
from mcdenoise.engines import Engine, LocalEngine, RayEngine, parse_workers
from mcdenoise.errors import InputError
from mcdenoise.film import ShotResult, read_film, run_film, write_page
from mcdenoise.shot import ShotSettings


def film(
    manifest: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="FILM")]],
    out: Out,
    model: str | None = None,
    workers: Workers = "1",
    piece: int = 200,
) -> int | None:
    """Denoise the shots of a film, by any number of processes or machines: OUT/NAME/ is what denoise writes of a shot.

    The same command again resumes the film: it denoises the frames that are not finished, or whose files, settings,
    weights or version have changed. What failed is listed at the end with the reason, and the status is 1.

    Args:
        manifest: TOML file with a table [[shot]] for each shot: name, input (a folder, a file, a pattern or a list of
            these), and any option of `mcdenoise denoise`; [every] has options of all. Or a pattern of folders, in
            quotes, such as 'renders/*/beauty', each of which is a shot.
        out: folder to write to: a folder for each shot, film.json, and the page film.html.
        model: of all shots for which the manifest names none, as for `mcdenoise denoise`; the only place for code of
            your own, path/to/file.py:factory.
        workers: number of processes of this machine; or the address of a Ray cluster, such as auto, 10.0.0.1:6379, or
            local for one on this machine, all machines of which see the same folders.
        piece: largest number of frames that one process denoises of a shot; longer shots are cut into pieces that
            overlap by as many frames as the history needs; 0 cuts none.
    """
    if piece < 0:
        raise InputError(f"--piece: expected at least 0 frames, found {piece}")
    count = parse_workers(workers)
    # A process of a cluster has one processor where the film does not say otherwise; those of this machine share it.
    threads = 1 if count is None else max(1, torch.get_num_threads() // count) if count > 1 else None
    shots = read_film(manifest, ShotSettings(model, threads=threads))
    for settings in {each.settings.model: each.settings for each in shots if each.settings.model}.values():
        # The check of the film names a shot whose model cannot be made.
        with suppress(InputError):
            warn(settings.spelling.doubt)
    if count is None:
        gpus = any(each.settings.device.startswith("cuda") for each in shots)
        engine: Engine = RayEngine(workers, cpus=max(each.settings.threads or 1 for each in shots), gpus=float(gpus))
    else:
        engine = LocalEngine(count)
    began = time.perf_counter()
    with progress_bar() as progress:
        task = progress.add_task(f"scan {len(shots)} shots", total=None)

        def show(made: int, total: int | None) -> None:
            rate = made / (time.perf_counter() - began)
            if total is not None:
                progress.update(task, description=f"{made}/{total} frames, {rate:.2f}/s", completed=made, total=total)

        results = run_film(shots, out, engine, piece=piece, on_progress=show, on_shot=_print_shot)
    for each in results:
        if each.found is not None:
            warn(*(f"{each.shot.name}: {warning}" for warning in each.found.warnings))
    print_rows(
        [
            {"shot": each.shot.name, "frames": frames, "failed": why}
            for each in results
            for frames, why in each.failures()
        ]
    )
    page = ""
    try:
        page = f", {write_page(results, out)}"
    except InputError as error:
        warn(str(error))
    seconds, made = time.perf_counter() - began, sum(each.made for each in results)
    rate = f", {made / seconds:.2f}/s" if made else ""
    done = sum(each.complete for each in results)
    say(f"{done} of {len(shots)} shots complete, {made} frames made in {seconds:.1f} s{rate}: {out}{page}")
    return None if done == len(shots) else 1


def _print_shot(result: ShotResult) -> None:
    """Print one line for a shot that is summarized or has failed."""
    frames = len(result.found.numbers) if result.found is not None else 0
    kept = frames - len(result.missing)
    there = f", {kept} were there" if kept else ""
    failed = f", {len(result.failed)} failed" if result.failed else ", failed" if result.reason else ""
    picked = f"; picked {result.shot.picked}" if result.shot.picked else ""
    say(f"  {result.shot.name}: {frames} frames, {result.made} made{there}{failed}{picked}")
