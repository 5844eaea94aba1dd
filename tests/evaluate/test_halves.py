"""Errors without a reference: estimates against known errors of synthetic noise, in float64, and the command."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from commands import refuses, run, succeeds
from torch import Tensor

from mcdenoise.data import open_sequence, write_exr
from mcdenoise.evaluate import evaluate_halves
from mcdenoise.evaluate.halves import weights

HEIGHT, WIDTH, FRAMES = 70, 100, 2


def truth(frame: int) -> Tensor:
    """A scene with edges, dark and bright places, ``(1, 3, H, W)``."""
    y, x = torch.meshgrid(torch.arange(HEIGHT) / HEIGHT, torch.arange(WIDTH) / WIDTH, indexing="ij")
    light = 0.05 + x * (1.2 + torch.sin(12 * y + frame)) + 3 * ((x - 0.5).square() + (y - 0.5).square() < 0.02)
    return (light * torch.tensor([1.0, 0.7, 0.4])[:, None, None])[None]


def rendered(image: Tensor, seed: int) -> Tensor:
    """Noise that is skewed, as that of few paths, and alike in the channels."""
    generator = torch.Generator().manual_seed(seed)
    normal = torch.randn((4, 1, 1, *image.shape[-2:]), generator=generator)
    return image * normal.square().mean(0)


def blurred(image: Tensor, side: int) -> Tensor:
    return torch.nn.functional.avg_pool2d(image, side, 1, side // 2, count_include_pad=False)


def write(folder: Path, images: dict[int, Tensor]) -> Path:
    folder.mkdir()
    for number, image in images.items():
        pixels = np.ascontiguousarray(image[0].permute(1, 2, 0).numpy())
        write_exr(folder / f"{folder.name}_{number:04d}.exr", pixels, ["R", "G", "B"], full_float=True)
    return folder


Shot = Callable[..., dict[str, Path]]


@pytest.fixture
def shot(tmp_path: Path) -> Shot:
    """Two renderings of a shot, and the first one blurred by two sizes."""

    def made(seed: int = 0, **filters: int) -> dict[str, Path]:
        folder = tmp_path / str(seed)
        folder.mkdir()
        a, b = ({frame: rendered(truth(frame), seed + 10 * frame + half) for frame in range(FRAMES)} for half in (0, 1))
        clean = {name: {i: blurred(image, side) for i, image in a.items()} for name, side in filters.items()}
        return {name: write(folder / name, images) for name, images in {"a": a, "b": b, **clean}.items()}

    return made


def read(folder: Path) -> list[Tensor]:
    sequence = open_sequence(folder)
    return [sequence.frame(number).color.double() for number in sequence.numbers]


def test_estimates_are_the_errors_against_the_truth_within_their_uncertainty(shot: Shot) -> None:
    inside, apart = 0, []
    for seed in range(0, 2000, 100):
        folders = shot(seed, narrow=3, wide=5)
        a, b, narrow, wide = (read(folder) for folder in folders.values())
        images = {name: folders[name] for name in ("narrow", "wide")}
        result = evaluate_halves(*(open_sequence(folders[half]) for half in "ab"), images, lambda _: None)
        assert (result.frames, result.doubts) == (FRAMES, [])
        clean = [truth(frame).double() for frame in range(FRAMES)]

        def error(images: list[Tensor], a: Any = a, b: Any = b, clean: Any = clean) -> float:
            pairs = zip(images, a, b, clean, strict=True)
            return float(
                torch.stack([(weights(x, y) * (image - t).square()).mean() for image, x, y, t in pairs]).mean()
            )

        exact = {"noisy": error(a), "narrow": error(narrow), "wide": error(wide)}
        for name in ("narrow", "wide"):
            value, margin = result.error(name)
            inside += abs(value - exact[name]) <= margin
        value, margin = result.difference("narrow", "wide")
        inside += abs(value - exact["narrow"] + exact["wide"]) <= margin
        apart.append((value - exact["narrow"] + exact["wide"]) / margin)
        assert result.error("noisy")[0] == pytest.approx(exact["noisy"], rel=0.25)
        assert result.ranking[-1] == "noisy"
    # 95 of 100 are expected; the bars also contain the differences between places of the image, and are wide.
    assert inside >= 55
    # Twenty estimates do not err to one side: their mean is within three of its deviations.
    assert abs(sum(apart)) / len(apart) < 3 * 0.5 / math.sqrt(len(apart))


def test_the_command_says_which_is_better_and_by_how_much(shot: Shot, tmp_path: Path) -> None:
    folders, file = shot(narrow=3, wide=5, wider=5), tmp_path / "halves.json"
    images = [folders[name] for name in ("narrow", "wide", "wider")]
    printed = succeeds("evaluate", folders["a"], *images, "--half", folders["b"], "--json", file)
    best, *_ = written = json.loads(file.read_text())["error"]
    assert f"{best} is better than {folders['narrow']}: its error is lower by " in printed
    assert "too little to tell" in printed
    assert len(printed.splitlines()) < 24
    assert set(written) == {"noisy", *map(str, images)}
    # The halves in the wrong order.
    status, _, said = run("evaluate", folders["b"], images[0], "--half", folders["a"])
    assert status == 0
    assert said.startswith(f"warning: {images[0]}: its noise is that of ")


def test_halves_that_say_nothing_are_refused(shot: Shot, tmp_path: Path) -> None:
    folders = shot(clean=3)
    a, b, clean = (folders[name] for name in ("a", "b", "clean"))
    assert "found the same image" in refuses("evaluate", a, clean, "--half", a)
    assert "found none" in refuses("evaluate", a, "--half", b)
    assert "found --protocol" in refuses("evaluate", a, clean, "--half", b, "--protocol", "noisebase")
    assert "found both" in refuses("evaluate", a, clean, "--half", b, "--model", "noisy")
    assert "several are compared by --half" in refuses("evaluate", a, clean, clean)
    assert f"found 1 frames (0 to 0) of {WIDTH} x" in refuses("evaluate", a, clean, "--half", b / "b_0000.exr")
    small = {name: write(tmp_path / name, {0: torch.rand(1, 3, 16, 90)}) for name in ("c", "d")}
    assert "found 1 frames (0 to 0) of 90 x 16" in refuses("evaluate", small["c"], clean, "--half", small["d"])
