"""Renderers with a fixed seed: the noise of every frame is that of the first one."""

import warnings
from typing import Any

import pytest
import torch
from planes import exponential

from mcdenoise import Denoiser, Frame

SIZE = 48, 64


def shot(frames: int, seeds: int = 1, noise: float = 1.0, **changes: Any) -> tuple[list[Frame], torch.Tensor]:
    """Frames of a still checker in light that falls off, with as many seeds; and the image without noise."""
    rows, columns = torch.meshgrid(*(torch.arange(side) / side for side in SIZE), indexing="ij")
    albedo = (0.2 + 0.6 * (((rows * 4).floor() + (columns * 6).floor()) % 2)).expand(1, 3, -1, -1).contiguous()
    clean = albedo * (0.5 + 0.5 * columns)
    normal = torch.tensor([0.0, 0.0, 1.0]).reshape(1, 3, 1, 1).expand_as(clean).contiguous()
    depth, motion = torch.full_like(clean[:, :1], 2), torch.zeros_like(clean[:, :2])
    given = {"albedo": albedo, "normal": normal, "depth": depth, "motion": motion, **changes}
    found = []
    for number in range(frames):
        draws = exponential(1, 1, *SIZE, seed=number % seeds)
        found.append(Frame(clean * (1 - noise + noise * draws), **given))
    return found, clean


@pytest.mark.parametrize("name", ["wild_small", "svgf"])
def test_equal_noise_counts_once(name: str) -> None:
    denoiser = Denoiser(name, precision="float32")
    frames, clean = shot(5)
    errors = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for frame in frames:
            errors.append(float((denoiser(frame) - clean).abs().mean()))
    assert errors == pytest.approx([errors[0]] * len(errors), rel=1e-4)
    assert len(caught) == 1
    assert "seed" in str(caught[0].message)
    assert "seed" in denoiser.report.repeats


def test_a_repeated_frame_takes_the_place_of_the_last_one_in_the_history() -> None:
    """Also in the middle of a shot, and the history goes on when the noise is new."""
    frames, _ = shot(5, seeds=5)
    given = [*frames[:3], frames[2], frames[2], *frames[3:]]
    expected, found = Denoiser("accumulated"), Denoiser("accumulated")
    found.warns = False
    images = [found(frame) for frame in given]
    for number, frame in zip((0, 1, 4, 5, 6), frames, strict=True):
        assert torch.equal(images[number], expected(frame))
    assert torch.equal(images[2], images[4])


@pytest.mark.parametrize(
    ("seeds", "noise", "changes"),
    [
        (5, 1.0, {}),
        # A converged frame may be equal to the one before.
        (1, 0.0, {}),
        (1, 0.02, {}),
        # What moves shows other noise on each surface.
        (1, 1.0, {"motion": torch.ones(1, 2, *SIZE)}),
    ],
)
def test_other_frames_have_their_history(seeds: int, noise: float, changes: dict[str, Any]) -> None:
    denoiser = Denoiser("accumulated")
    for frame in shot(5, seeds, noise, **changes)[0]:
        denoiser(frame)
        assert not denoiser.report.repeats
    assert not denoiser.report.reset
