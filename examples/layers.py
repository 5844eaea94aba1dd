"""Measure the error and the run time of denoised light layers, on a shot that Blender rendered with its light passes.

    python examples/blender/render.py -o shot --frames 8 --samples 1 --filter none
    python examples/blender/render.py -o shot --name reference --frames 8 --samples 256 --filter none --seed 1001
    python examples/layers.py shot [METHOD...]

Each method denoises the shot three times: the color alone, the color with its layers, and every layer separately.
Errors are squared differences from the reference over ``reference color^2 + 0.01``, times 1000, and SMAPE; for the
layers, the sum of the former and the mean of the latter. Times are medians over the frames after the first, without
reading and writing files. The last column is the mean difference of the sum of the layers from the color, relative to
the mean of the color.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from mcdenoise import Denoiser, Frame
from mcdenoise.data import open_sequence
from mcdenoise.errors import InputError
from mcdenoise.metrics import smape_linear

METHODS = ("wild", "wild_small", "joint_bilateral", "oidn")
Images = dict[str, Tensor]


def load(files: Path) -> list[Frame]:
    """The frames of a shot with all their light layers."""
    sequence = open_sequence(files, lights=["all"])
    return [sequence.frame(number) for number in sequence.numbers]


def denoised(frames: list[Frame], denoise: Callable[[Frame], Images]) -> tuple[list[Images], float]:
    """The images of each frame by name, and the median milliseconds per frame."""
    images, times = [], []
    for frame in frames:
        start = time.perf_counter()
        images.append(denoise(frame))
        times.append(1e3 * (time.perf_counter() - start))
    return images, sorted(times[1:])[len(times[1:]) // 2]


def report(name: str, images: list[Images], milliseconds: float, references: list[Frame]) -> None:
    """Print one row: time, errors of the color and of the layers, and the error of the sum of the layers."""
    names = ["color", *references[0].layers]
    errors, smapes, apart = [], [], []
    for found, reference in zip(images, references, strict=True):
        truth = {"color": reference.color, **reference.layers}
        scale = reference.color.square() + 0.01
        errors.append([1e3 * float(((found[each] - truth[each]).square() / scale).mean()) for each in names])
        smapes.append([float(smape_linear(found[each], truth[each])) for each in names])
        total = torch.stack([found[each] for each in names[1:]]).sum(0)
        apart.append(float((total - found["color"]).abs().mean() / found["color"].mean()))
    (color, *layers), (color_smape, *layer_smapes) = torch.tensor([errors, smapes]).mean(1).tolist()
    figures = f"{color:.1f} | {color_smape:.4f} | {sum(layers):.1f} | {sum(layer_smapes) / len(layers):.4f}"
    print(f"| {name} | {milliseconds:.0f} ms | {figures} | {sum(apart) / len(apart):.1e} |", flush=True)


def main(shot: Path, methods: Sequence[str]) -> None:
    """Print a table."""
    frames, references = (load(shot / f"{kind}_####.exr") for kind in ("shot", "reference"))
    names = ("color", *frames[0].layers)
    print(f"{len(names) - 1} layers: {', '.join(names[1:])}")
    print("| | time | color | SMAPE | layers | SMAPE | sum |\n|---|--:|--:|--:|--:|--:|--:|")
    for method in methods:
        alone, together = Denoiser(method), Denoiser(method)
        _, milliseconds = denoised(frames, lambda frame, alone=alone: {"color": alone(frame)})
        print(f"| `{method}`, color alone | {milliseconds:.0f} ms | | | | | |")

        def with_layers(frame: Frame, denoiser: Denoiser = together) -> Images:
            output = denoiser.output(frame, stages=False)
            return {"color": output.image, **output.layers}

        report("with layers", *denoised(frames, with_layers), references)
        each = {name: Denoiser(method) for name in names}

        def by_itself(frame: Frame, denoisers: dict[str, Denoiser] = each) -> Images:
            images = {"color": frame.color, **frame.layers}
            return {name: denoisers[name](frame.replace(color=images[name], layers={})) for name in names}

        report("every layer by itself", *denoised(frames, by_itself), references)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(f"usage: {sys.argv[0]} SHOT [METHOD...]")
    try:
        main(Path(sys.argv[1]), sys.argv[2:] or METHODS)
    except InputError as error:
        sys.exit(f"{sys.argv[0]}: {error}")
