"""`mcdenoise calibrate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from mcdenoise.cli._options import Out
from mcdenoise.cli._output import progress_bar, say
from mcdenoise.data import open_sequence
from mcdenoise.data.files import atomic_path
from mcdenoise.denoiser import Denoiser
from mcdenoise.errors import InputError
from mcdenoise.models import calibrating, describe_weights, load_weights, save_weights


def calibrate(
    weights: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="WEIGHTS")]],
    sequences: tyro.conf.Positional[tuple[Path, ...]],
    out: Out,
    frames: str | None = None,
) -> None:
    """Calibrate weights for --precision int8: record the ranges of all tensors in the model's U-Nets on some frames.

    Values beyond these ranges are clamped inside the network, though not in the image. Use frames like those that will
    be denoised, such as some of the training data. The weights themselves do not change.

    Args:
        weights: safetensors file of a model with a U-Net.
        sequences: folders of sequences; references are not needed.
        out: file to write, which may be the input file.
        frames: frames of each sequence to use, such as 0-3; all by default.
    """
    if not sequences:
        raise InputError("sequences: expected frames for the calibration, found none")
    about = describe_weights(weights)
    architecture, settings = about.pop("architecture"), about.pop("settings")
    model = load_weights(weights)
    opened = [open_sequence(folder, frames) for folder in sequences]
    with progress_bar() as progress, calibrating(model):
        task = progress.add_task("calibrate", total=sum(len(sequence) for sequence in opened))
        for sequence in opened:
            denoiser = Denoiser(model, precision="float32", keep_all=True)
            for number in sequence.numbers:
                denoiser(sequence.frame(number))
                progress.advance(task)
    with atomic_path(out) as temporary:
        temporary.write_bytes(save_weights(model, architecture, settings, about))
    say(f"calibrated on {sum(len(sequence) for sequence in opened)} frames: {out}")
