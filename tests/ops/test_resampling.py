"""Bicubic resampling beside torch's own; its equation and its limit are in the oracle."""

import torch
import torch.nn.functional as F
from reference_cases import draw
from torch import Tensor

from mcdenoise.ops import resample


def by_torch(previous: Tensor, motion: Tensor) -> Tensor:
    """``grid_sample``, whose coordinates are -1 and 1 at the centres of the outermost pixels."""
    height, width = previous.shape[-2:]
    y, x = torch.meshgrid(*(torch.arange(side, dtype=motion.dtype) for side in (height, width)), indexing="ij")
    grid = torch.stack([(x + motion[:, 0]) / (width - 1), (y + motion[:, 1]) / (height - 1)], -1) * 2 - 1
    return F.grid_sample(previous, grid, mode="bicubic", padding_mode="border", align_corners=True)


def test_it_is_torchs_bicubic_interpolation_where_the_range_of_the_nearest_pixels_does_not_limit_it() -> None:
    previous, motion = draw(2, 3, 17, 23), 12 * (draw(2, 2, 17, 23, seed=1) - 0.5)
    alike = (resample(previous, motion) - by_torch(previous, motion)).abs() < 1e-12
    assert 0.5 < alike.double().mean() < 1
