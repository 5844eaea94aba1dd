"""`mcdenoise denoise`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
import tyro

from mcdenoise.cli._options import Json, Out, check_threads
from mcdenoise.cli._output import print_times, progress_bar, stages, write_json
from mcdenoise.data import open_sequence
from mcdenoise.denoise import denoise_sequence
from mcdenoise.denoiser import Denoiser, Precision
from mcdenoise.errors import InputError
from mcdenoise.heap import keep_heap, return_heap
from mcdenoise.plan import TOLERANCE, Plan


def denoise(
    sequence: tyro.conf.Positional[Path],
    out: Out,
    model: str = "cascaded",
    weights: Path | None = None,
    frames: str | None = None,
    device: str = "cpu",
    threads: int | None = None,
    precision: Precision = "float32",
    alpha_min: float = 0.1,
    anti_lag: bool = True,
    full_float: bool = False,
    keep_all: bool = False,
    tolerance: float = TOLERANCE,
    tile: int | None = None,
    max_memory: float | None = None,
    budget_ms: float | None = None,
    max_error: float | None = None,
    results: Path | None = None,
    json: Json = None,
) -> None:
    """Denoise a folder of frames: writes OUT/denoisedN.exr and OUT/denoise.json.

    Args:
        sequence: folder of a sequence in a known layout.
        out: folder to write to.
        model: name of a model, see `mcdenoise models`.
        weights: safetensors file of your own weights for that model.
        frames: which frames, such as 0-59,70; all by default.
        device: cpu or cuda.
        threads: CPU threads; torch's choice by default.
        precision: of the network's convolutions; bfloat16 is faster on processors that have it.
        alpha_min: smallest weight of the current frame in the accumulation, in (0, 1].
        anti_lag: give up the accumulated past where the light has changed.
        full_float: write 32-bit instead of half floats.
        keep_all: leave nothing out, whether the sequence needs it or not.
        tolerance: noise, or change, relative to its mean, below which a tile of a still shot is not denoised again;
            0 leaves out only what makes no difference.
        tile: run the network on tiles of at most so many pixels a side, a multiple of 32 from 64 on; the result is that
            of whole frames, to rounding. By default, frames are tiled where the network's features would take more than
            2 GB.
        max_memory: of this process, in GB; chooses the tiles, and whether the next frame is read meanwhile.
        budget_ms: take the shipped model and precision with the least error (or, where no error is known, the
            slowest) that needs no more milliseconds a frame on this machine, measured once and without files.
        max_error: take the fastest one with an SMAPE that is no larger.
        results: folder of a finished benchmark to take errors from; those of the sequence's references by default.
        json: write the run times to this file too.
    """
    keep_heap()
    if threads is not None:
        check_threads(threads)
        torch.set_num_threads(threads)
    if not 0 < alpha_min <= 1:
        raise InputError(f"--alpha-min: expected in (0, 1], found {alpha_min}")
    opened = open_sequence(sequence, frames)
    if budget_ms is not None or max_error is not None:
        if weights is not None:
            raise InputError("--budget-ms, --max-error: expected no --weights, which are of one model")
        # Here because it brings the benchmark, which takes its time to load.
        from mcdenoise.budget import choose_model

        with progress_bar() as progress:
            task = progress.add_task("measure models", total=None)
            choice = choose_model(
                opened,
                budget=budget_ms,
                max_error=max_error,
                results=results,
                device=device,
                on_step=lambda done, total: progress.update(task, completed=done, total=total),
            )
        print(f"picked {choice}")
        model, precision = choice.model, choice.precision
    plan = Plan(keep_all=keep_all, tolerance=tolerance)
    if max_memory is not None:
        return_heap()
    denoiser = Denoiser(
        model,
        weights=weights,
        device=device,
        alpha_min=alpha_min,
        anti_lag=anti_lag,
        precision=precision,
        plan=plan,
        tile=tile,
        max_memory=max_memory,
    )
    height, width = opened.size
    print(f"{opened.name}: {opened.layout} layout, {len(opened)} frames of {width}x{height}")
    with progress_bar() as progress:
        task = progress.add_task("denoise", total=len(opened))
        report = denoise_sequence(
            opened,
            out,
            denoiser,
            str(weights or model),
            half=not full_float,
            on_frame=lambda: progress.advance(task),
        )
    for row in report.plan:
        print(f"  {row['stage']}: {_kept(row)} ({row['reason']}){'' if row['exact'] else ', up to the tolerance'}")
    if report.replaced_pixels:
        print(f"replaced {report.replaced_pixels} NaN, infinite, negative or absurdly bright pixels of the noisy color")
    print(f"  tiles: {report.tiles}")
    print_times(report.milliseconds)
    print(f"{'beside that' if denoiser.has_room_ahead else 'of the waiting'}: {stages(report.beside)}")
    write_json(json, {"model": report.model, "milliseconds": report.milliseconds, "beside": report.beside})


def _kept(row: dict[str, Any]) -> str:
    share = row["left_out"]
    return "kept" if share == 0 else "left out" if share == 1 else f"{share:.1%} left out"
