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
from mcdenoise.methods import Spelling, parse_method
from mcdenoise.models import calibrating, describe_weights, load_weights, model_of, save_weights


def calibrate(
    weights: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="WEIGHTS")]],
    sequences: tyro.conf.Positional[tuple[Path, ...]],
    out: Out,
    frames: str | None = None,
) -> None:
    """Calibrate weights for --precision int8: record the ranges of all tensors in the model's U-Nets on some frames.

    Values beyond these ranges are clamped inside the network, though not in the image. Use frames like those that will
    be denoised, such as some of the training data. The weights themselves do not change.

    Args:
        weights: safetensors file of a model with a U-Net; of your own, file.py:factory(weights=FILE).
        sequences: folders of sequences; references are not needed.
        out: file to write, which may be the input file.
        frames: frames of each sequence to use, such as 0-3; all by default.
    """
    if not sequences:
        raise InputError("sequences: expected frames for the calibration, found none")
    path = Path(weights)
    spelling = Spelling(model_of(path), path) if path.is_file() else parse_method(weights)
    if spelling.weights is None or spelling.settings:
        raise InputError(f"weights: expected a safetensors file, or file.py:factory(weights=FILE), found '{weights}'")
    about = describe_weights(spelling.weights)
    del about["architecture"]
    settings = about.pop("settings")
    model = load_weights(spelling.weights, spelling.model)
    opened = [open_sequence(folder, frames) for folder in sequences]
    with progress_bar() as progress, calibrating(model):
        task = progress.add_task("calibrate", total=sum(len(sequence) for sequence in opened))
        for sequence in opened:
            denoiser = Denoiser(model, precision="float32", keep_all=True)
            for number in sequence.numbers:
                denoiser(sequence.frame(number))
                progress.advance(task)
    with atomic_path(out) as temporary:
        temporary.write_bytes(save_weights(model, spelling.model, settings, about))
    say(f"calibrated on {sum(len(sequence) for sequence in opened)} frames: {out}")
