"""Close-ups for the pages of methods: ``python docs/site/close_ups.py DEMO`` writes ``docs/close_ups/``.

DEMO is what ``mcdenoise demo -o DEMO`` wrote. Each method that needs no training denoises its frames.
``METHOD.webp`` has two crops of the last frame, of the noisy image and of the reference; ``errors.csv`` has the errors
of that frame.
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import numpy as np
import PIL.Image
import torch
from torch import Tensor

from mcdenoise import Denoiser
from mcdenoise.data import open_sequence
from mcdenoise.data.png import Picture
from mcdenoise.errors import InputError
from mcdenoise.metrics import display_codes, psnr_srgb, smape_linear
from mcdenoise.models._overview import overview

FOLDER = Path(__file__).resolve().parents[1] / "close_ups"
# Left, top, width and height in pixels: books on a shelf, and a rough metal ball beside a glass one.
CROPS = ((40, 20, 112, 64), (96, 78, 112, 64))
GAP = 2


def main(demo: Path) -> None:
    """Denoise with every method, and write a picture of each and the errors of all."""
    sequence = open_sequence(demo / "sequence")
    frames = [sequence.frame(number, reference=number == sequence.numbers[-1]) for number in sequence.numbers]
    noisy, reference = frames[-1].color, frames[-1].reference
    if reference is None:
        raise InputError(f"{demo}: expected a reference of the last frame, found none; run `mcdenoise demo` again")
    FOLDER.mkdir(exist_ok=True)
    with (FOLDER / "errors.csv").open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file)
        table.writerow(["method", "SMAPE", "PSNR"])
        for entry in overview():
            if entry.reason or entry.weights == "to train":
                continue
            torch.manual_seed(0)
            try:
                denoiser = Denoiser(entry.name)
                for frame in frames:
                    image = denoiser(frame)
            except InputError as error:
                print(f"{entry.name}: skipped: {error}")
                continue
            PIL.Image.fromarray(sheet([noisy, image, reference])).save(
                FOLDER / f"{entry.name}.webp", quality=88, method=6
            )
            table.writerow([entry.name, *errors(image, reference)])


def errors(image: Tensor, reference: Tensor) -> tuple[str, str]:
    """SMAPE and PSNR."""
    return f"{float(smape_linear(image, reference)):.4f}", f"{float(psnr_srgb(image, reference)):.2f}"


def sheet(images: list[Tensor]) -> Picture:
    """Images side by side, a row for each crop."""
    shown = [display_codes(image[0]).permute(1, 2, 0).cpu().numpy() for image in images]
    rows = []
    for left, top, width, height in CROPS:
        crops = [picture[top : top + height, left : left + width] for picture in shown]
        rows.append(
            np.concatenate([np.pad(crop, ((0, GAP), (0, GAP), (0, 0)), constant_values=255) for crop in crops], 1)
        )
    return np.concatenate(rows)[:-GAP, :-GAP]


if __name__ == "__main__":
    main(Path(sys.argv[1]))
