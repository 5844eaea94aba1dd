"""`mcdenoise denoise`."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from mcdenoise.cli._options import Flag, Inputs, Json, Layers, Map, Out, check_threads
from mcdenoise.cli._output import print_times, progress_bar, say, stages, warn, write_json
from mcdenoise.cli.inspect import open_inputs, print_sequence
from mcdenoise.denoiser import AskedPrecision
from mcdenoise.errors import InputError
from mcdenoise.folder import denoise_sequence
from mcdenoise.frame import MOTION
from mcdenoise.heap import keep_heap, return_heap
from mcdenoise.methods import Spelling, parse_method
from mcdenoise.models import DEFAULT, describe_weights
from mcdenoise.preview import Preview


def denoise(
    inputs: Inputs,
    out: Out,
    model: str | None = None,
    weights: Path | None = None,
    frames: str | None = None,
    device: str = "cpu",
    threads: int | None = None,
    precision: AskedPrecision = "auto",
    map: Map = (),
    color_without_albedo: Flag = False,
    color_with_albedo: Flag = False,
    output_layer: str | None = None,
    layers: Layers = (),
    alpha: Flag = False,
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
    """Denoise the frames of a shot: writes the same files, clean, to OUT, and OUT/denoise.json.

    Args:
        inputs: a folder; files; or a pattern such as 'shot_####.exr', 'shot_%04d.exr' or 'shot_*.exr'. Each may be an
            EXR with layers, or one file a buffer; `mcdenoise inspect` shows what is taken from where.
        out: folder to write to: files of the same names, with the radiance replaced and all else as it was
            (of the BMFR layout: denoisedN.exr).
        model: a name, see `mcdenoise models`, with settings if need be, such as "oidn(quality=fast)"; a weights file;
            or a model of your own, path/to/file.py:factory or package.module:factory. By default cascaded_v2, or the
            model that the weights are of.
        weights: safetensors file of your own weights for that model.
        frames: frames to denoise, such as 0-59,70; all by default.
        device: where the model runs, cpu or cuda.
        threads: CPU threads; torch's choice by default.
        precision: precision of the network's convolutions; auto takes bfloat16 where the processor has it and it is
            faster, which is measured once on each machine.
        map: the layer to read a buffer from where names do not tell, such as albedo=RGBA.diff; 'motion=' reads none.
        color_without_albedo: the noisy color was divided by the albedo, which is multiplied back.
        color_with_albedo: the noisy color has the albedo in it. By default its values decide, and where they tell
            nothing, the color is taken to have it.
        output_layer: add the result as a layer of this name, and replace nothing.
        layers: layers of light to denoise with it, by the same kernels, so that they still add up: names such as
            DiffDir or Combined_*, or all.
        alpha: denoise the alpha too, by the same kernels; else it stays as it was.
        alpha_min: smallest weight of the current frame in the accumulation, in (0, 1]; the model's own by default.
        anti_lag: give up the history where the light has changed.
        full_float: write the result as 32-bit floats, even where it was stored as half floats.
        keep_all: skip nothing, whether the sequence needs it or not.
        tolerance: noise, or change, relative to the mean of a tile, below which a tile of a still shot is skipped;
            0 skips only tiles whose image stays the same.
        tile: run the network on tiles of at most so many pixels a side, a multiple of 32 from 64 on; the result is that
            of whole frames, to rounding. By default, frames are tiled where the network's features would take more than
            2 GB.
        max_memory: maximum memory of this process in GB; it decides the tiles, and whether the next frame is read
            meanwhile.
        budget_ms: take the shipped model and precision with the smallest error (or, where no error is known, the
            slowest) that need at most so many milliseconds a frame on this machine, measured once and without files.
        max_error: take the fastest model and precision whose SMAPE is at most this.
        results: folder of a finished benchmark to take errors from; those of the sequence's references by default.
        preview: write a PNG of each file to OUT/preview too, on the sRGB curve, and OUT/preview.mp4 of several frames.
        preview_fps: frames per second of that video.
        preview_exposure: exposure of the previews in stops; by default the first frame decides for all: its typical
            radiance is middle grey.
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
    opened = open_inputs(
        *(inputs, frames, map),
        without_albedo=color_without_albedo,
        with_albedo=color_with_albedo,
        lights=layers,
    )
    if output_layer is not None:
        opened.check_output_layer(output_layer)
    if alpha and "alpha" not in opened.buffers:
        raise InputError(f"--alpha: expected an alpha to denoise, found none in {opened.root}; leave the option out")
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
        say(f"picked {choice}")
        model, precision = choice.model, choice.precision
    spelling = _spelling(model, weights)
    # What is not asked for is not passed on: a model of another kind has no such setting.
    asked = {"alpha_min": alpha_min, "anti_lag": None if anti_lag else False, "tolerance": tolerance}
    settings = {name: value for name, value in asked.items() if value is not None}
    if max_memory is not None:
        return_heap()
    denoiser = spelling.denoiser(
        device=device, precision=precision, keep_all=keep_all, tile=tile, max_memory=max_memory, alpha=alpha, **settings
    )
    print_sequence(opened)
    began = time.perf_counter()
    with progress_bar() as progress:
        task = progress.add_task("denoise", total=len(opened))
        report = denoise_sequence(
            opened,
            out,
            denoiser,
            str(spelling.weights or spelling.name),
            full_float=full_float,
            output_layer=output_layer,
            on_frame=lambda: progress.advance(task),
            on_written=shown.add if shown else None,
        )
        taken = time.perf_counter() - began
        if shown:
            task = progress.add_task("preview", total=len(opened))
            shown.close(on_frame=lambda: progress.advance(task))
    for row in report.plan:
        say(f"  {row['stage']}: {_kept(row)} ({row['reason']}){'' if row['exact'] else ', up to the tolerance'}")
    if report.replaced_pixels:
        print(f"replaced {report.replaced_pixels} NaN, infinite, negative or absurdly bright pixels of the noisy color")
    print(f"  tiles: {report.tiles}")
    print(f"  precision: {denoiser.precision}, {report.precision}")
    print_times(report.milliseconds)
    print(f"{'beside that' if denoiser.has_room_ahead else 'of the waiting'}: {stages(report.beside)}")
    absent = {name for done in report.frames.values() for name in done.missing}
    if missing := sorted(absent - (MOTION if len(opened) == 1 else frozenset())):
        say(f"without {', '.join(missing)}, with which {report.model} is better")
    warn(report.warnings)
    files = list(report.files.values())
    names = files[0].name if len(files) == 1 else f"{files[0].name} to {files[-1].name}"
    write_json(json, {"model": report.model, "milliseconds": report.milliseconds, "beside": report.beside})
    if shown:
        say(f"preview: {shown.written[-1]}")
    say(f"{len(files)} {'frame' if len(files) == 1 else 'frames'} in {taken:.1f} s: {out / names}")


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
