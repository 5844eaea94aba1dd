"""Denoise a shot frame by frame, as in a renderer: the shortest use of `Denoiser`.

    python examples/denoise_sequence.py path/to/sequence out
    python examples/denoise_sequence.py path/to/sequence out --weights runs/mine/wild.safetensors

The script writes out/denoised0.exr, out/denoised1.exr, ... (scene-linear), and out/last.png: the last frame before and
after, as displayed. A denoiser has a state: pass it the frames in order, and use one `Denoiser` for each shot. If the
frames do not come from a folder, construct `mcdenoise.frame.Frame(color=..., albedo=..., ...)` yourself.
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from mcdenoise import Denoiser
from mcdenoise.data import open_sequence, write_exr
from mcdenoise.data.png import write_png
from mcdenoise.metrics import displayed
from mcdenoise.models import DEFAULT


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("sequence", type=Path, help="folder of a renderer's frames")
    parser.add_argument("out", type=Path, help="folder to write to")
    parser.add_argument("--model", default=DEFAULT, help="a name that `mcdenoise models` lists, or file.py:factory")
    parser.add_argument("--weights", type=Path, help="weights that you trained; by default the shipped ones")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    options = parser.parse_args()

    sequence = open_sequence(options.sequence)
    denoiser = Denoiser(options.model, weights=options.weights, device=options.device)
    options.out.mkdir(parents=True, exist_ok=True)
    for number in sequence.numbers:
        frame = sequence.frame(number, reference=False)
        image = denoiser(frame)
        pixels = image[0].permute(1, 2, 0).cpu().numpy()
        write_exr(options.out / f"denoised{number}.exr", pixels, ["R", "G", "B"])
        milliseconds = sum(denoiser.report.milliseconds.values())
        print(f"frame {number}: {milliseconds:.0f} ms {denoiser.report.reset and f'({denoiser.report.reset})'}")

    pair = torch.cat([frame.color, image.cpu()], 3)
    picture = displayed(pair[0]).permute(1, 2, 0).numpy()
    write_png(options.out / "last.png", (picture * 255 + 0.5).astype(np.uint8))
    print(f"images and last.png (before and after) are in {options.out}")


if __name__ == "__main__":
    main()
