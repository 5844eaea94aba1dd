from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.ops import kernel_splat, learned_upsample, pyramid_partition

SIZES = [(16, 32), (5, 7), (1, 9), (1, 1), (33, 18)]
every_size = pytest.mark.parametrize(("height", "width"), SIZES)


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def uniform_kernel(image: Tensor, side: int = 4) -> Tensor:
    """Equal weights that sum to 4."""
    return torch.full((len(image), side**2, *image.shape[-2:]), 4 / side**2, dtype=image.dtype)


def pixels_of_blocks(height: int, width: int, side: int) -> Tensor:
    """Return how many pixels of the image each block holds."""
    ones = torch.zeros(-(-height // side), -(-width // side), dtype=torch.float64)
    for y in range(height):
        for x in range(width):
            ones[y // side, x // side] += 1
    return ones


@every_size
def test_the_levels_hold_all_of_the_light(height: int, width: int) -> None:
    image, logits = draw(2, 3, height, width), 6 * draw(2, 5, height, width, seed=1)
    levels = pyramid_partition(image, logits)
    light = sum((part * pixels_of_blocks(height, width, 1 << i)).sum((2, 3)) for i, part in enumerate(levels))
    torch.testing.assert_close(light, image.sum((2, 3)), rtol=1e-12, atol=0)


@every_size
def test_all_on_one_level_is_the_image_at_that_size(height: int, width: int) -> None:
    image = draw(1, 3, height, width)
    for chosen in range(3):
        logits = torch.zeros(1, 3, height, width, dtype=torch.float64)
        logits[:, chosen] = 1e4
        for level, part in enumerate(pyramid_partition(image, logits)):
            side = 1 << level
            mean = F.avg_pool2d(image, side, ceil_mode=True, count_include_pad=False)
            assert torch.equal(part, mean if level == chosen else torch.zeros_like(mean))


@pytest.mark.parametrize("side", [2, 4])
@every_size
def test_a_constant_image_stays_constant_with_equal_weights(height: int, width: int, side: int) -> None:
    coarse = torch.full((2, 3, (height + 1) // 2, (width + 1) // 2), 0.7, dtype=torch.float64)
    found = learned_upsample(coarse, uniform_kernel(coarse, side), (height, width))
    torch.testing.assert_close(found, torch.full_like(found, 0.7), rtol=1e-14, atol=0)


@pytest.mark.parametrize("side", [2, 4, 6])
def test_a_sum_of_weights_of_4_keeps_the_light(side: int) -> None:
    coarse = draw(2, 3, 3, 5)
    kernel = 4 * torch.softmax(4 * draw(2, side**2, 3, 5, seed=1), 1)
    found = learned_upsample(coarse, kernel, (6, 10))
    torch.testing.assert_close(found.sum((2, 3)), 4 * coarse.sum((2, 3)), rtol=1e-12, atol=0)
    # Light that is two pixels or more from the border does not leave the image.
    inner = coarse.clone()
    inner[..., [0, -1], :] = inner[..., [0, -1]] = 0
    lost = learned_upsample(inner, kernel, (6, 10), border="zeros")
    torch.testing.assert_close(lost.sum((2, 3)), 4 * inner.sum((2, 3)), rtol=1e-12, atol=0)


def test_taps_lie_around_the_pixels_that_a_coarse_one_covers() -> None:
    """One coarse pixel in the middle, whose 16 taps are numbered."""
    coarse = torch.zeros(1, 1, 3, 3)
    coarse[..., 1, 1] = 1
    kernel = torch.arange(16.0).reshape(1, 16, 1, 1).expand(1, 16, 3, 3)
    found = learned_upsample(coarse, kernel, (6, 6))
    assert torch.equal(found[0, 0, 1:5, 1:5], torch.arange(16.0).reshape(4, 4))
    assert found[0, 0].sum() == torch.arange(16).sum()


def test_a_pyramid_of_the_two_keeps_the_light_of_an_image() -> None:
    """Down in parts, up again coarse to fine, with splats in between that keep all inside: nothing is lost."""
    image = draw(1, 3, 16, 24)
    levels = pyramid_partition(image, draw(1, 3, 16, 24, seed=1))
    result = torch.zeros_like(levels[-1])
    for level in (2, 1, 0):
        part = levels[level]
        kernel = torch.softmax(draw(1, 25, *part.shape[-2:], seed=2 + level), 1)
        result = result + kernel_splat(part, kernel)
        if level:
            up = 4 * torch.softmax(draw(1, 16, *part.shape[-2:], seed=5 + level), 1)
            result = learned_upsample(result, up, (2 * part.shape[-2], 2 * part.shape[-1]))
    torch.testing.assert_close(result.sum(), image.sum(), rtol=1e-12, atol=0)


def test_half_precision_sums_many_fireflies() -> None:
    image = torch.full((1, 3, 33, 18), 6e4, dtype=torch.float16)
    logits = torch.zeros(1, 5, 33, 18, dtype=torch.float16)
    for part in pyramid_partition(image, logits):
        torch.testing.assert_close(part, torch.full_like(part, 6e4 / 5))
