"""`mcdenoise denoise`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
import tyro

from mcdenoise.cli._options import Json, Out, check_threads
from mcdenoise.cli._output import print_times, progress_bar, stages, write_json
from mcdenoise.data import open_sequence
from mcdenoise.denoiser import Precision
from mcdenoise.errors import InputError
from mcdenoise.folder import denoise_sequence
from mcdenoise.heap import keep_heap, return_heap
from mcdenoise.methods import Spelling, parse_method
from mcdenoise.models import DEFAULT, describe_weights
from mcdenoise.preview import Preview


def denoise(
    sequence: tyro.conf.Positional[Path],
    out: Out,
    model: str | None = None,
    weights: Path | None = None,
    frames: str | None = None,
    device: str = "cpu",
    threads: int | None = None,
    precision: Precision = "float32",
    alpha_min: float | None = None,
    anti_lag: bool = True,
    full_float: bool = False,
    keep_all: bool = False,
    tolerance: float | None = None,
    tile: int | None = None,
    max_memory: float | None = None,
    budget_ms: float | None = None,
    max_error: float | None = None,
    results: Path | None = None,
    preview: bool = False,
    preview_fps: float = 24.0,
    preview_exposure: float | None = None,
    json: Json = None,
) -> None:
    """Denoise a folder of frames: writes OUT/denoisedN.exr and OUT/denoise.json.

    Args:
        sequence: folder of a sequence in a known layout.
        out: folder to write to.
        model: a name, see `mcdenoise models`, with settings if need be, such as "oidn(quality=fast)"; a weights file;
            or a model of your own, path/to/file.py:factory or package.module:factory. By default cascaded_v2, or the
            model that the weights are of.
        weights: safetensors file of your own weights for that model.
        frames: which frames, such as 0-59,70; all by default.
        device: cpu or cuda.
        threads: CPU threads; torch's choice by default.
        precision: of the network's convolutions; bfloat16 is faster on processors that have it.
        alpha_min: smallest weight of the current frame in the accumulation, in (0, 1]; the model's own by default.
        anti_lag: give up the history where the light has changed.
        full_float: write 32-bit instead of half floats.
        keep_all: skip nothing, whether the sequence needs it or not.
        tolerance: noise, or change, relative to its mean, below which a tile of a still shot is not denoised again;
            0 skips only what makes no difference.
        tile: run the network on tiles of at most so many pixels a side, a multiple of 32 from 64 on; the result is that
            of whole frames, to rounding. By default, frames are tiled where the network's features would take more than
            2 GB.
        max_memory: of this process, in GB; chooses the tiles, and whether the next frame is read meanwhile.
        budget_ms: take the shipped model and precision with the least error (or, where no error is known, the
            slowest) that needs no more milliseconds a frame on this machine, measured once and without files.
        max_error: take the fastest one with an SMAPE that is no larger.
        results: folder of a finished benchmark to take errors from; those of the sequence's references by default.
        preview: write OUT/preview/denoisedN.png too, on the sRGB curve, and OUT/preview.mp4 of several frames.
        preview_fps: frames per second of that video.
        preview_exposure: in stops; by default the first frame decides for all: its typical radiance is middle grey.
        json: write the run times to this file too.
    """
    keep_heap()
    if threads is not None:
        check_threads(threads)
        torch.set_num_threads(threads)
    if alpha_min is not None and not 0 < alpha_min <= 1:
        raise InputError(f"--alpha-min: expected in (0, 1], found {alpha_min}")
    if not preview and (preview_fps != 24.0 or preview_exposure is not None):
        raise InputError("--preview-fps, --preview-exposure: expected together with --preview")
    opened = open_sequence(sequence, frames)
    shown = None
    if preview:
        shown = Preview(out, video=len(opened) > 1, frames_per_second=preview_fps, exposure=preview_exposure)
    if budget_ms is not None or max_error is not None:
        if weights is not None or model is not None:
            raise InputError("--budget-ms, --max-error: expected no --model or --weights: they choose it")
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
    spelling = _spelling(model, weights)
    # What is not asked for is not passed on: a model of another kind has no such setting.
    asked = {"alpha_min": alpha_min, "anti_lag": None if anti_lag else False, "tolerance": tolerance}
    settings = {name: value for name, value in asked.items() if value is not None}
    if max_memory is not None:
        return_heap()
    denoiser = spelling.denoiser(
        device=device, precision=precision, keep_all=keep_all, tile=tile, max_memory=max_memory, **settings
    )
    height, width = opened.size
    print(f"{opened.name}: {opened.layout} layout, {len(opened)} frames of {width}x{height}")
    with progress_bar() as progress:
        task = progress.add_task("denoise", total=len(opened))
        report = denoise_sequence(
            opened,
            out,
            denoiser,
            str(spelling.weights or spelling.name),
            half=not full_float,
            on_frame=lambda: progress.advance(task),
            on_written=shown.add if shown else None,
        )
        if shown:
            task = progress.add_task("preview", total=len(opened))
            shown.close(on_frame=lambda: progress.advance(task))
    for row in report.plan:
        print(f"  {row['stage']}: {_kept(row)} ({row['reason']}){'' if row['exact'] else ', up to the tolerance'}")
    if report.replaced_pixels:
        print(f"replaced {report.replaced_pixels} NaN, infinite, negative or absurdly bright pixels of the noisy color")
    print(f"  tiles: {report.tiles}")
    print_times(report.milliseconds)
    print(f"{'beside that' if denoiser.has_room_ahead else 'of the waiting'}: {stages(report.beside)}")
    write_json(json, {"model": report.model, "milliseconds": report.milliseconds, "beside": report.beside})
    if shown:
        print(f"preview: {shown.written[-1]}")


def _spelling(model: str | None, weights: Path | None) -> Spelling:
    """The model that is asked for, or that the weights are of, or the default."""
    if weights is None:
        return parse_method(model or DEFAULT)
    if model is None:
        return Spelling(str(describe_weights(weights)["architecture"]), weights)
    return replace(parse_method(model), weights=weights)


def _kept(row: dict[str, Any]) -> str:
    fraction = row["skipped"]
    return "kept" if fraction == 0 else "skipped" if fraction == 1 else f"{fraction:.1%} skipped"
