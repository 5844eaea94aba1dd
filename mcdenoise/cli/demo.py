"""`mcdenoise demo`: render a noisy animation, denoise it, and show what came of it."""

from __future__ import annotations

import os
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from mcdenoise.benchmark import BASELINES, Settings, choose_methods, run_benchmark
from mcdenoise.benchmark.tables import scene_rows
from mcdenoise.cli._options import Out
from mcdenoise.cli._output import print_rows, print_times, progress_bar, say
from mcdenoise.data import open_sequence
from mcdenoise.data.files import make_folder
from mcdenoise.data.png import Picture, caption, enlarge, write_png
from mcdenoise.folder import denoise_sequence
from mcdenoise.heap import keep_heap
from mcdenoise.methods import parse_method
from mcdenoise.models import DEFAULT
from mcdenoise.report import check_packages, kept_pictures, read_picture, write_report
from mcdenoise.report.gallery import REFERENCE
from mcdenoise.report.pictures import Image, to_srgb
from mcdenoise.results import FILE, Results
from mcdenoise.scenes.demo import demo_cameras, demo_scene
from mcdenoise.scenes.render import render_sequence

FRAMES = 10
SIZE = (320, 180)
REFERENCE_SPP = 64
REFERENCE_FRAMES = (8, 9)
# Frames whose pictures are in the report, which stays below 8 MB.
_PICTURES = 6
# Open Image Denoise in the setting that has the smallest errors on sequences, see docs/results.md.
PEER = "oidn(quality=high, auxiliary=clean, source=accumulated after)"
# Beside the baselines and the chosen model: a filter of each kind, Open Image Denoise, and models with shipped weights.
COMPARED = f"{PEER},joint_bilateral(sigma_color=0.2, sigma_space=4.0),svgf,wild_small,wild,wild_large"
# The close-ups of the picture: left, top, width and height as fractions of the image.
_CLOSE_UP = (0.42, 0.40, 0.25, 0.25)


def demo(out: Out = Path("demo"), model: str = DEFAULT) -> None:
    """Render 10 frames of a small scene at one sample per pixel, denoise them, and print errors and run times.

    Then compare the error and the run time of several models, filters and installed denoisers in a report.

    Args:
        out: folder to write to; frames that an earlier run rendered there are reused.
        model: a name with optional settings, a weights file, or file.py:factory, as for `mcdenoise denoise`.
    """
    keep_heap()
    check_packages()
    spelling = parse_method(model)
    denoiser = spelling.denoiser()
    make_folder(out)
    with progress_bar() as progress:
        rendering = progress.add_task("render", total=None)
        denoising = progress.add_task("denoise", total=FRAMES)
        comparing = progress.add_task("compare", total=None)
        render_sequence(
            demo_scene(),
            demo_cameras(FRAMES),
            out / "sequence",
            size=SIZE,
            reference_spp=REFERENCE_SPP,
            reference_frames=REFERENCE_FRAMES,
            # It needs nothing but Mitsuba's package.
            variant="scalar_rgb",
            progress=lambda done, total: progress.update(rendering, completed=done, total=total),
        )
        report = denoise_sequence(
            open_sequence(out / "sequence"),
            out / "denoised",
            denoiser,
            spelling.name,
            on_frame=lambda: progress.advance(denoising),
        )
        results = _compare(out, model, lambda done, total: progress.update(comparing, completed=done, total=total))
    write_png(out / "demo.png", _sheet(out / "report", results, spelling.name))
    write_report(out / "report")
    print_rows(scene_rows(results))
    print_times(report.milliseconds)
    for what, path in {"clean frames": "denoised", "picture": "demo.png", "report": "report/index.html"}.items():
        say(f"{what}: {out / path}")


def _compare(out: Path, model: str, on_step: Callable[[int, int], None]) -> Results:
    """Several methods on the frames of the demonstration; replaces the report of an earlier run."""
    folder = out / "report"
    if os.path.exists(folder / FILE):
        shutil.rmtree(folder)
    settings = Settings(
        rounds=1,
        threads=torch.get_num_threads(),
        pictures=_PICTURES,
        memory=False,
        command=f"mcdenoise demo -o {shlex.quote(str(out))} --model {shlex.quote(model)}",
    )
    sequence = replace(open_sequence(out / "sequence"), name="demo")
    methods = choose_methods(COMPARED, precisions="float32", baselines=(*BASELINES, model))
    return run_benchmark([sequence], methods, folder, settings, on_step=on_step)


def _sheet(folder: Path, results: Results, model: str) -> Picture:
    """The last frame several times side by side, and under each image a close-up."""
    (scene,) = results.scenes
    files, last = kept_pictures(folder, results, scene), scene.pictures[-1]
    shown = {
        "1 sample a pixel": "noisy",
        "accumulated": "accumulated",
        "Open Image Denoise": parse_method(PEER).name,
        "mcdenoise": model,
        f"reference, {REFERENCE_SPP} samples": REFERENCE,
    }
    images = {text: files[name][last] for text, name in shown.items() if name in files}
    return np.concatenate([_column(text, read_picture(path, scene)) for text, path in images.items()], 1)


def _column(text: str, image: Image) -> Picture:
    picture = to_srgb(image)
    height, width, _ = picture.shape
    left, top, wide, high = _CLOSE_UP
    x, y = int(left * width), int(top * height)
    close_up = enlarge(picture[y : y + int(high * height), x : x + int(wide * width)], round(1 / wide))
    gap = np.zeros((4, width, 3), np.uint8)
    column = np.concatenate([caption(picture, text), gap, close_up[:, :width]])
    return np.pad(column, ((2, 2), (2, 2), (0, 0)))
