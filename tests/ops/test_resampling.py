"""Bicubic resampling: known answers, torch's own, and what it does to a history."""

from __future__ import annotations

import cmath
import math

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.testing import assert_close

from mcdenoise import ops
from mcdenoise.ops import reproject, resample

BACKENDS = ("torch", "numba")


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def shift(right: float, down: float, height: int, width: int) -> Tensor:
    return torch.tensor([right, down], dtype=torch.float64).reshape(1, 2, 1, 1).expand(1, 2, height, width)


def by_torch(previous: Tensor, motion: Tensor) -> Tensor:
    """``grid_sample``, whose coordinates are -1 and 1 at the centres of the outermost pixels."""
    height, width = previous.shape[-2:]
    y, x = torch.meshgrid(*(torch.arange(side, dtype=motion.dtype) for side in (height, width)), indexing="ij")
    grid = torch.stack([(x + motion[:, 0]) / (width - 1), (y + motion[:, 1]) / (height - 1)], -1) * 2 - 1
    return F.grid_sample(previous, grid, mode="bicubic", padding_mode="border", align_corners=True)


@pytest.mark.parametrize("backend", BACKENDS)
def test_it_is_torchs_bicubic_interpolation_within_the_range_of_the_nearest_pixels(backend: str) -> None:
    previous, motion = draw(2, 3, 17, 23), 12 * (draw(2, 2, 17, 23, seed=1) - 0.5)
    with ops.use(backend):
        value = resample(previous, motion)
    expected = by_torch(previous, motion)
    inside = (value - expected).abs() < 1e-12
    assert inside.any()
    # All others are limited to the range of the nearest pixels.
    assert not inside.all()
    lowest, highest = nearest(previous, motion)
    assert ((value >= lowest) & (value <= highest)).all()
    assert torch.equal(value[~inside], torch.where(expected > highest, highest, lowest)[~inside])


def nearest(previous: Tensor, motion: Tensor) -> tuple[Tensor, Tensor]:
    """The smallest and the largest of the four nearest pixels; outside, the edge is repeated."""
    height, width = previous.shape[-2:]
    y, x = torch.meshgrid(*(torch.arange(side, dtype=motion.dtype) for side in (height, width)), indexing="ij")
    left, top = (x + motion[:, :1]).floor().long(), (y + motion[:, 1:]).floor().long()
    places = [
        ((top + j).clamp(0, height - 1) * width + (left + k).clamp(0, width - 1)).expand_as(previous)
        for j in (0, 1)
        for k in (0, 1)
    ]
    taps = torch.stack([previous.flatten(2).gather(2, at.flatten(2)).reshape(previous.shape) for at in places])
    return taps.amin(0), taps.amax(0)


def test_runs_of_pixels_that_move_alike_have_the_reference_result() -> None:
    # A zoom that shows more than the image, and pixels without a place.
    previous = draw(1, 2, 30, 40)
    rows, columns = torch.meshgrid(torch.arange(30.0), torch.arange(40.0), indexing="ij")
    motion = torch.stack([0.3 * (columns - 18), 0.2 * (rows - 13)])[None].double()
    motion[:, 0, ::7, ::5] = torch.inf
    with ops.use("torch"):
        expected = resample(previous, motion)
    with ops.use("numba"):
        assert_close(resample(previous, motion), expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("backend", BACKENDS)
def test_whole_pixels_are_exact_and_the_edge_is_repeated(backend: str) -> None:
    previous = draw(1, 3, 6, 7)
    with ops.use(backend):
        assert torch.equal(resample(previous, shift(0, 0, 6, 7)), previous)
        moved = resample(previous, shift(2, -1, 6, 7))
        assert torch.equal(moved[..., 1:, :5], previous[..., :5, 2:])
        assert torch.equal(moved[..., 0, :5], previous[..., 0, 2:])
        assert torch.equal(moved[..., 1:, 5:], previous[..., :5, 6:].expand(1, 3, 5, 2))
        far = resample(previous, shift(1e9, 0, 6, 7))
    assert torch.equal(far, previous[..., 6:].expand_as(previous))


@pytest.mark.parametrize("backend", BACKENDS)
def test_unknown_motion_gives_zero(backend: str) -> None:
    motion = torch.zeros(1, 2, 2, 3, dtype=torch.float64)
    motion[0, 0, 0, 0], motion[0, 1, 0, 1], motion[0, 0, 1, 2] = torch.inf, torch.nan, -torch.inf
    with ops.use(backend):
        value = resample(torch.ones(1, 1, 2, 3, dtype=torch.float64), motion)
    assert value.flatten().tolist() == [0, 0, 1, 1, 1, 0]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.bfloat16])
def test_both_backends_agree_in_every_dtype_and_layout(dtype: torch.dtype) -> None:
    previous, motion = draw(2, 5, 9, 11).to(dtype), (6 * (draw(2, 2, 9, 11, seed=2) - 0.5)).float()
    with ops.use("torch"):
        expected = resample(previous, motion)
    with ops.use("numba"):
        found = resample(previous, motion)
        strided = resample(previous.contiguous(memory_format=torch.channels_last), motion.mT.contiguous().mT)
    assert found.dtype == dtype
    # Sums of 16 products, in two orders, of values of at most 1 and weights that add up to at most 2; then both round.
    sums, rounded = 16 * 2 * torch.finfo(torch.float32).eps, torch.finfo(dtype).eps
    assert_close(found, expected, rtol=0 if dtype == torch.float32 else rounded, atol=sums)
    assert torch.equal(found, strided)


def test_a_history_stays_sharper_than_by_bilinear_interpolation() -> None:
    # Stripes of eight pixels and of amplitude 1 move by 0.4 pixels a frame, for eight frames.
    x = torch.arange(64, dtype=torch.float64)
    motion = shift(0.4, 0, 8, 64)
    bilinear = bicubic = (1 + torch.cos(2 * torch.pi * x / 8)).expand(1, 1, 8, 64)
    for _ in range(8):
        bilinear, bicubic = reproject(bilinear, motion)[0], resample(bicubic, motion)
    waves = torch.exp(-2j * torch.pi * x / 8)
    amplitudes = [2 * ((each[0, 0, 0] - 1) * waves)[16:48].mean().abs() for each in (bilinear, bicubic)]
    step = 0.6 + 0.4 * cmath.exp(2j * math.pi / 8)
    assert float(amplitudes[0]) == pytest.approx(abs(step) ** 8)
    assert float(amplitudes[1]) == pytest.approx(1, abs=0.1)
