"""Error of denoised layers, and what they cost, of a shot that ``render.py`` has rendered.

    python examples/layers/compare.py SHOT
    python examples/layers/compare.py SHOT cascaded_v2_micro joint_bilateral

Each method denoises the shot three times: the color alone, the color with its layers, and every layer by itself. Errors
are squared differences from the layer's reference over ``reference color^2 + 0.01``, so that they may be compared with
that of the color, times 1000; and SMAPE. Times are medians over the frames after the first. The last column is how far
the sum of the layers is from the color, on average, relative to its mean.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import OpenImageIO as oiio
import torch
from torch import Tensor

from mcdenoise import Denoiser, Frame
from mcdenoise.metrics import smape_linear

LAYERS = {"diffuse": "Diff", "glossy": "Gloss", "transmission": "Trans"}
METHODS = ("cascaded_v2", "cascaded_v2_small", "cascaded_v2_tiny", "joint_bilateral", "oidn")


def load(path: Path) -> Frame:
    """A frame with its layers, of the passes of Cycles."""
    file = oiio.ImageInput.open(str(path))
    names = [name.partition(".")[2] for name in file.spec().channelnames]
    pixels = torch.from_numpy(file.read_image("float")).permute(2, 0, 1)

    def image(name: str, channels: str = "RGB") -> Tensor:
        return torch.stack([pixels[names.index(f"{name}.{channel}")] for channel in channels])[None]

    layers = {name: image(f"{key}Col") * (image(f"{key}Dir") + image(f"{key}Ind")) for name, key in LAYERS.items()}
    depth = image("Depth", "Z")
    return Frame(
        image("Combined"),
        albedo=image("Denoising Albedo").clamp(0, 1),
        normal=image("Denoising Normal", "XYZ").clamp(-1, 1),
        depth=torch.where(depth > 1e9, torch.inf, depth),
        motion=image("Vector", "XY") * torch.tensor([1.0, -1.0]).reshape(1, 2, 1, 1),
        layers={**layers, "emission": image("Emit"), "environment": image("Env")},
    )


def denoised(
    frames: list[Frame], denoise: Callable[[Frame], dict[str, Tensor]]
) -> tuple[list[dict[str, Tensor]], float]:
    """Images by name of each frame, and milliseconds for one."""
    images, times = [], []
    for frame in frames:
        start = time.perf_counter()
        images.append(denoise(frame))
        times.append(1e3 * (time.perf_counter() - start))
    return images, sorted(times[1:])[len(times[1:]) // 2]


def report(name: str, images: list[dict[str, Tensor]], milliseconds: float, references: dict[int, Frame]) -> None:
    """One row: time, and for the color and each layer the error and SMAPE."""
    cells = []
    for layer in ("color", *references[1].layers):
        errors, smapes = [], []
        for number, frame in references.items():
            reference = frame.color if layer == "color" else frame.layers[layer]
            found = images[number - 1][layer]
            errors.append(1e3 * float(((found - reference).square() / (frame.color.square() + 0.01)).mean()))
            smapes.append(float(smape_linear(found, reference)))
        cells.append(f"{sum(errors) / len(errors):.2f}, {sum(smapes) / len(smapes):.4f}")
    apart = [
        float((sum(layer for key, layer in found.items() if key != "color") - found["color"]).abs().mean())
        / float(found["color"].mean())
        for found in images
    ]
    row = [name, f"{milliseconds:.0f} ms", *cells, f"{sum(apart) / len(apart):.1e}"]
    print(f"| {' | '.join(row)} |", flush=True)


def main(shot: Path, methods: Sequence[str]) -> None:
    """Print a table."""
    frames = [load(path) for path in sorted(shot.glob("noisy_*.exr"))]
    references = {int(path.stem[-4:]): load(path) for path in sorted(shot.glob("reference_*.exr"))}
    names = ("color", *frames[0].layers)
    print(f"| | time | {' | '.join(names)} | sum |\n|---|--:|{'---|' * len(names)}--:|")
    for method in methods:
        alone = Denoiser(method)
        _, milliseconds = denoised(frames, lambda frame, alone=alone: {"color": alone(frame)})
        print(f"| `{method}`, color alone | {milliseconds:.0f} ms |{' |' * len(names)} |")
        together = Denoiser(method)

        def with_layers(frame: Frame, denoiser: Denoiser = together) -> dict[str, Tensor]:
            output = denoiser.output(frame, stages=False)
            return {"color": output.image, **output.layers}

        report("with layers", *denoised(frames, with_layers), references)
        each = {name: Denoiser(method) for name in names}

        def by_itself(frame: Frame, denoisers: dict[str, Denoiser] = each) -> dict[str, Tensor]:
            images = {"color": frame.color, **frame.layers}
            return {name: denoisers[name](frame.replace(color=images[name], layers={})) for name in names}

        report("every layer by itself", *denoised(frames, by_itself), references)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:] or METHODS)
