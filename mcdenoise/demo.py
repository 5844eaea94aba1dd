"""The demonstration: render a noisy animation, denoise it, and show what came of it."""

from __future__ import annotations

import os
import shlex
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mcdenoise.benchmark import BASELINES, Score, Settings, choose_methods, run_benchmark, scores_of
from mcdenoise.data import open_sequence
from mcdenoise.data.files import make_folder
from mcdenoise.data.png import Picture, caption, enlarge, write_png
from mcdenoise.folder import denoise_sequence
from mcdenoise.frame import Frame
from mcdenoise.methods import parse_method
from mcdenoise.metrics import display_codes
from mcdenoise.models import DEFAULT, Output
from mcdenoise.models._registry import find_model
from mcdenoise.report import check_packages, write_report
from mcdenoise.results import FILE
from mcdenoise.scenes.demo import demo_cameras, demo_scene
from mcdenoise.scenes.render import render_sequence
from mcdenoise.sequence_report import SequenceReport

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


@dataclass(frozen=True)
class DemoResult:
    """The results of the demonstration.

    Args:
        scores: errors of the noisy and the accumulated image, those on the way and the result, over the frames with
            references.
        report: run times by stage, and what was done.
        picture: noisy, accumulated, by Open Image Denoise in its best setting where that is installed, denoised and
            reference side by side, with close-ups.
        denoised: folder of the clean EXRs.
        page: the report of error against run time of several methods.
    """

    scores: list[Score]
    report: SequenceReport
    picture: Path
    denoised: Path
    page: Path


def run_demo(
    out: Path,
    *,
    model: str = DEFAULT,
    variant: str | None = "scalar_rgb",
    on_render: Callable[[int, int], None] = lambda done, total: None,
    on_frame: Callable[[], None] = lambda: None,
    on_compare: Callable[[int, int], None] = lambda done, total: None,
) -> DemoResult:
    """Render 10 frames at one sample a pixel, denoise them, and compare the last ones with references.

    Frames that an earlier run rendered into the same folder are used again; its report is replaced.

    Args:
        out: folder to write to: ``sequence/``, ``denoised/``, ``demo.png`` and ``report/``.
        model: see :func:`mcdenoise.methods.parse_method`.
        variant: of Mitsuba; ``"scalar_rgb"`` needs nothing but its package.
        on_render: called with finished and total paths a pixel.
        on_frame: called after each denoised frame.
        on_compare: called with finished and all steps of the comparison that is reported.

    Raises:
        InputError: Mitsuba or a package of the report is missing, the model is unknown, or the folder cannot be
            written to.
    """
    check_packages()
    spelling = parse_method(model)
    denoiser = spelling.denoiser()
    make_folder(out)
    render_sequence(
        demo_scene(),
        demo_cameras(FRAMES),
        out / "sequence",
        size=SIZE,
        reference_spp=REFERENCE_SPP,
        reference_frames=REFERENCE_FRAMES,
        variant=variant,
        progress=on_render,
    )
    sequence = open_sequence(out / "sequence")
    peer = parse_method(PEER).denoiser() if find_model("oidn").installed else None
    last: list[tuple[Frame, Output, Tensor | None]] = []

    def show(frame: Frame, output: Output) -> None:
        last[:] = [(frame, output, peer(frame) if peer else None)]
        on_frame()

    report = denoise_sequence(sequence, out / "denoised", denoiser, spelling.name, references=True, on_output=show)
    picture = out / "demo.png"
    write_png(picture, _sheet(*last[0]))
    folder, scores = _compare(out, model, on_compare)
    names = {*BASELINES, spelling.name, *(f"{spelling.name}, {stage}" for stage in last[0][1].stages)}
    shown = [score for score in scores if score.method in names]
    return DemoResult(shown, report, picture, out / "denoised", write_report(folder))


def _compare(out: Path, model: str, on_step: Callable[[int, int], None]) -> tuple[Path, list[Score]]:
    """Several methods on the frames of the demonstration; the folder of the results, and the errors."""
    folder, threads = out / "report", torch.get_num_threads()
    if os.path.exists(folder / FILE):
        shutil.rmtree(folder)
    settings = Settings(
        rounds=1,
        threads=threads,
        pictures=_PICTURES,
        on_the_way=True,
        memory=False,
        command=f"mcdenoise demo -o {shlex.quote(str(out))} --model {shlex.quote(model)}",
    )
    sequence = replace(open_sequence(out / "sequence"), name="demo")
    methods = choose_methods(COMPARED, precisions="float32", baselines=(*BASELINES, model))
    return folder, scores_of(run_benchmark([sequence], methods, folder, settings, on_step=on_step))


def _sheet(frame: Frame, output: Output, peer: Tensor | None) -> Picture:
    """A frame several times side by side, and under each image a close-up."""
    shown = {
        "1 sample a pixel": frame.color,
        "accumulated": output.stages.get("accumulated"),
        "Open Image Denoise": peer,
        "mcdenoise": output.image,
        f"reference, {REFERENCE_SPP} samples": frame.reference,
    }
    return np.concatenate([_column(text, image) for text, image in shown.items() if image is not None], 1)


def _column(text: str, image: Tensor) -> Picture:
    picture = display_codes(image[0]).permute(1, 2, 0).cpu().numpy()
    height, width, _ = picture.shape
    left, top, wide, high = _CLOSE_UP
    x, y = int(left * width), int(top * height)
    close_up = enlarge(picture[y : y + int(high * height), x : x + int(wide * width)], round(1 / wide))
    gap = np.zeros((4, width, 3), np.uint8)
    column = np.concatenate([caption(picture, text), gap, close_up[:, :width]])
    return np.pad(column, ((2, 2), (2, 2), (0, 0)))
