"""Bicubic resampling: known answers, torch's own, and what it does to a history."""

import pytest
import torch
import torch.nn.functional as F
from reference_cases import draw
from torch import Tensor

from mcdenoise import ops
from mcdenoise.ops import resample

BACKENDS = ("torch", "numba")


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
