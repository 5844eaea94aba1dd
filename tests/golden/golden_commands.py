"""What commands print and write for the files of renderers, and the losses of a short training."""

import io
import json
import re
from contextlib import redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import torch
from golden_shots import MOVING
from torch import Tensor

from mcdenoise.cli import main

COMMANDS = "commands"
TEXTS = Path(__file__).with_name("inspect.txt")
FOLDERS = sorted(path.parent for path in Path(__file__).parents[1].glob("data/renderers/*/*") if path.suffix == ".exr")
FOLDERS = list(dict.fromkeys(FOLDERS))
STEPS = 3
# Largest relative differences. Measured between two kinds of processor: 1e-5 of pixels, which are written as half
# floats, and 1e-4 of the losses.
PIXELS, LOSSES = 1e-3, 1e-3
_NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[+-]?\d+)?")


def said(*arguments: object) -> str:
    """What a command prints, without frames of tables and the place of the folder, one line for each."""
    out = io.StringIO()
    with redirect_stdout(out), redirect_stderr(out), suppress(SystemExit):
        main([str(each) for each in arguments])
    text = out.getvalue().replace(f"{FOLDERS[0].parent}/", "")
    lines = (" ".join(re.sub(r"[^\x20-\x7e]", " ", line).split()) for line in text.splitlines())
    return "\n".join(line for line in lines if line)


def texts() -> dict[str, str]:
    """What `inspect` prints, by folder."""
    parts = re.split(r"^# (.*)\n", TEXTS.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    return {name: text.strip() for name, text in zip(parts[::2], parts[1::2], strict=True)}


def same(found: str, expected: str) -> bool:
    """Whether two texts are equal up to the rounding of numbers."""
    pairs = list(zip(_NUMBER.findall(found), _NUMBER.findall(expected), strict=False))
    close = all(abs(float(one) - float(other)) <= 0.02 * abs(float(other)) + 1e-4 for one, other in pairs)
    return _NUMBER.sub("0", found) == _NUMBER.sub("0", expected) and close


def written(folder: Path, out: Path) -> Tensor:
    """Means of 4x4 cells of every channel that `denoise` writes with the default model, ``(channels, 16)``."""
    said("denoise", folder, "-o", out, "--precision", "float32")
    return torch.cat([torch.zeros(0, 16), *(_cells(path) for path in sorted(out.glob("**/*.exr")))])


def _cells(path: Path) -> Tensor:
    parts = []
    image = oiio.ImageBuf(str(path))
    for part in range(image.nsubimages):
        image = oiio.ImageBuf(str(path), part, 0)
        pixels = np.asarray(image.get_pixels(oiio.FLOAT)).transpose(2, 0, 1)
        order = np.argsort(image.spec().channelnames)
        pixels = torch.from_numpy(np.nan_to_num(pixels[order], posinf=0, neginf=0))
        parts.append(torch.nn.functional.adaptive_avg_pool2d(pixels, 4).flatten(1))
    return torch.cat(parts)


def losses(folder: Path) -> Tensor:
    """The losses of three steps of a training that starts from shipped weights."""
    for number, frame in enumerate(MOVING.frames()):
        for name in ("color", "albedo", "normal", "depth", "position", "reference"):
            _write(folder / "shot" / f"{name}{number}.exr", frame.buffer(name))
    options: dict[str, Any] = {"model": "wild_small", "start-from": "wild_small", "steps": STEPS}
    options |= {"batch": 2, "frames": 2, "crop": 32, "validation-frames": 0, "checkpoint-every": 1}
    given = [text for name, value in options.items() for text in (f"--{name}", value)]
    said("train", folder / "shot", "-o", folder / "run", *given)
    log = [json.loads(line) for line in (folder / "run" / "log.jsonl").read_text().splitlines()]
    return torch.tensor([step["loss"] for step in log if "loss" in step])


def _write(path: Path, image: Tensor | None) -> None:
    assert image is not None
    path.parent.mkdir(exist_ok=True)
    pixels = np.ascontiguousarray(image[0].permute(1, 2, 0).numpy())
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], oiio.FLOAT)
    file = oiio.ImageOutput.create(str(path))
    file.open(str(path), spec)
    file.write_image(pixels)
    file.close()
