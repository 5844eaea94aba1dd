"""MRKP and KP against their equations, written out in float64 with loops."""

from __future__ import annotations

from typing import Any

import pytest
import torch
import torch.nn.functional as F
from test_cascaded import halved
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


def features(unet: Any, x: Tensor) -> list[Tensor]:
    """Return the features of the finest three decoders, layer by layer."""
    height, width = x.shape[-2:]
    x = F.pad(x, (0, -width % 32, 0, -height % 32), mode="replicate")
    skips, found = [], []
    for layer in unet.encoder:
        skips.append(F.conv2d(x, layer.weight, layer.bias, padding=1).clamp_min(0))
        x = halved(skips[-1])
    for layer in unet.decoder:
        # Each pixel writes its 3x3 weights around twice its place.
        spread = x.new_zeros(1, layer.out_channels, 2 * x.shape[2] + 2, 2 * x.shape[3] + 2)
        for i in range(3):
            for j in range(3):
                part = torch.einsum("bchw,cd->bdhw", x, layer.weight[:, :, i, j])
                spread[..., i : i + 2 * x.shape[2] : 2, j : j + 2 * x.shape[3] : 2] += part
        up = spread[..., 1:-1, 1:-1] + layer.bias[:, None, None]
        x = torch.cat([up.clamp_min(0), skips.pop()], 1)
        found.append(x)
    return [level[..., : -(-height // 2**scale), : -(-width // 2**scale)] for scale, level in enumerate(found[:-4:-1])]


@pytest.mark.parametrize("size", [(1, 1), (2, 4), (5, 6), (6, 9)])
def test_upsampling_aligned_with_the_even_pixels(size: tuple[int, int]) -> None:
    height, width = size
    image = torch.rand(1, 2, -(-height // 2), -(-width // 2), dtype=torch.float64)
    found = aligned(image, height, width)
    assert torch.equal(found[..., ::2, ::2], image)
    torch.testing.assert_close(found, copied(image, height, width))
