"""MRKP and KP against their equations, written out in float64 with loops."""

import pytest
import torch
from torch import Tensor

from mcdenoise.models.mrkp import aligned


def copied(image: Tensor, height: int, width: int) -> Tensor:
    """Even pixels copy, odd ones are the mean of those of their neighbours that there are."""
    out = image.new_zeros(*image.shape[:2], height, width)
    for y in range(height):
        for x in range(width):
            rows = {y // 2, min(y // 2 + y % 2, image.shape[2] - 1)}
            columns = {x // 2, min(x // 2 + x % 2, image.shape[3] - 1)}
            taps = [image[..., row, column] for row in rows for column in columns]
            out[..., y, x] = sum(taps) / len(taps)
    return out


@pytest.mark.parametrize("size", [(1, 1), (2, 4), (5, 6), (6, 9)])
def test_upsampling_aligned_with_the_even_pixels(size: tuple[int, int]) -> None:
    height, width = size
    image = torch.rand(1, 2, -(-height // 2), -(-width // 2), dtype=torch.float64)
    found = aligned(image, height, width)
    assert torch.equal(found[..., ::2, ::2], image)
    torch.testing.assert_close(found, copied(image, height, width))
