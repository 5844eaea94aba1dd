"""A renderer that streams frames may rely on this: nothing of its own is kept, nothing bad is remembered."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from commands import succeeds
from planes import leaning_wall
from torch import Tensor

from mcdenoise import Denoiser, Frame, ops
from mcdenoise.data import read_exr
from mcdenoise.data.readers.bmfr import write_bmfr_frame

# A fast model with shipped weights.
MODEL = "wild_small"
HEIGHT, WIDTH = 40, 72


def scene(number: int, *, still: bool = False, without: tuple[str, ...] = (), sky: bool = False) -> Frame:
    """A wall that a camera moves along, or stands before; noise in the left half only, so that tiles converge."""
    wall = leaning_wall(number, WIDTH, HEIGHT, step=0.0 if still else 1.0)
    noise = torch.rand(1, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(number))
    color = wall["albedo"] * torch.where(torch.arange(WIDTH) < 36, 2 * noise, 1 + 0.001 * (noise - 0.5))
    frame = Frame(color=color, **wall)
    if sky:
        frame = frame.replace(depth=torch.full((1, 1, HEIGHT, WIDTH), torch.inf), color=torch.ones_like(color))
    return frame.replace(**dict.fromkeys(without))


def with_motion(number: int) -> Frame:
    """Return a frame whose history is found by motion vectors alone."""
    motion = torch.full((1, 2, HEIGHT, WIDTH), 0.4)
    return scene(number, without=("position", "view_projection")).replace(motion=motion)


SHOTS: dict[str, Callable[[int], Frame]] = {
    "moving": scene,
    "still": lambda number: scene(number, still=True),
    "motion vectors": with_motion,
    "still without albedo": lambda number: scene(number, still=True, without=("albedo",)),
    "sky": lambda number: scene(number, still=True, sky=True),
    "color": lambda number: Frame(color=scene(number).color),
}
FRAMES = 11


@pytest.fixture(params=SHOTS)
def shot(request: pytest.FixtureRequest) -> list[Frame]:
    return [SHOTS[request.param](number) for number in range(FRAMES)]


def denoised(frames: list[Frame], denoiser: Denoiser | None = None) -> list[Tensor]:
    denoiser = denoiser or Denoiser(MODEL)
    return [denoiser(frame).clone() for frame in frames]


def in_one_place(frames: list[Frame]) -> Iterator[Frame]:
    """Yield the frames as a renderer does that writes every frame into the same buffers."""
    place = Frame(**{name: torch.empty_like(value) for name, value in frames[0].items()})
    for frame in frames:
        for (_, mine), (_, value) in zip(place.items(), frame.items(), strict=True):
            mine.copy_(value)
        yield place


def test_a_renderer_may_write_every_frame_into_the_same_buffers(shot: list[Frame]) -> None:
    expected, denoiser = denoised(shot), Denoiser(MODEL)
    found = [denoiser(frame) for frame in in_one_place(shot)]
    # The images are not cloned: those that were handed out stay unchanged.
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


@torch.inference_mode()
def sealed(color: Tensor, albedo: Tensor) -> Tensor:
    """A model of a user who only denoises: it knows no derivatives."""
    return color * 0.5 + albedo


def one_color(color: Tensor, albedo: Tensor) -> Tensor:
    """All pixels are one."""
    return (color * albedo).mean((2, 3), keepdim=True).expand_as(color)


@pytest.mark.parametrize("given", [True, False], ids=["frames of inference mode", "ordinary frames"])
@pytest.mark.parametrize("model", [MODEL, "noisy", "accumulated", sealed, one_color])
def test_an_image_is_an_ordinary_tensor_whatever_the_model_and_the_frame_are(model: Any, given: bool) -> None:
    denoiser, again = Denoiser(model), Denoiser(model)
    for number in range(2):
        with torch.inference_mode(given):
            frame = scene(number)
        output, expected = denoiser.output(frame), again(frame)
        assert torch.equal(output.image, expected)
        for image in (*output.stages.values(), output.image):
            before = image.clone()
            image.clamp_(0, 1)
            image *= 2
            image[:, :, 0, 0] = 3
            assert torch.equal(image[..., 1:, 1:], before.clamp(0, 1)[..., 1:, 1:] * 2)
            scale = torch.ones((), requires_grad=True)
            (image * scale).mean().backward()
            torch.testing.assert_close(scale.grad, image.mean())


@pytest.mark.parametrize(
    ("name", "albedo", "where"),
    [("moving", None, slice(10, 11)), ("still", 0.0, slice(None)), ("motion vectors", 1e-3, slice(10, 20))],
)
def test_the_largest_radiance_that_is_one_stays_finite(name: str, where: slice, albedo: float | None) -> None:
    denoiser = Denoiser(MODEL)
    for frame in [SHOTS[name](number) for number in range(FRAMES)]:
        color = frame.color.clone()
        color[..., where, where] = 1e16
        dark = None if albedo is None else torch.full_like(color, albedo)
        output = denoiser.output(frame.replace(color=color, albedo=dark))
        assert denoiser.report.replaced_pixels == 0
        assert "accumulated" in output.stages
        for image in (*output.stages.values(), output.image):
            assert image.isfinite().all()
            assert image.max() <= 1.01e16


def run(sequence: Path, out: Path, frames: str) -> tuple[np.ndarray, str]:
    """The last image of `mcdenoise denoise`, and what its report says of that frame's past."""
    printed = succeeds("denoise", sequence, "-o", out, "--model", MODEL, "--frames", frames, "--full-float")
    # The warning of a gap does not say that the renderer wrote no motion.
    assert "read without" not in printed
    number, done = list(json.loads((out / "denoise.json").read_text())["frames"].items())[-1]
    return read_exr(out / f"denoised{number}.exr")[0], done["reset"]


def test_motion_across_frames_that_were_not_chosen_is_not_followed(tmp_path: Path) -> None:
    for number in range(5):
        write_bmfr_frame(tmp_path / "motion" / "inputs", number, with_motion(number))
    # A still is computed in plain torch, whose rounding is not that of compiled steps.
    with ops.use("torch"):
        alone, _ = run(tmp_path / "motion", tmp_path / "alone", "4")
        after_a_gap, why = run(tmp_path / "motion", tmp_path / "gap", "0-1,4")
    assert why
    assert np.array_equal(after_a_gap, alone)
    followed, why = run(tmp_path / "motion", tmp_path / "followed", "0-1,3-4")
    assert not why
    assert not np.array_equal(followed, alone)
