from __future__ import annotations

import pytest
import torch
from torch import Tensor

from mcdenoise.ops import downsample, laplacian_fusion, upsample

SIZES = [(4, 6), (5, 7), (1, 8), (1, 1), (2, 3)]
every_size = pytest.mark.parametrize(("height", "width"), SIZES)


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def half(height: int, width: int) -> tuple[int, int]:
    return (height + 1) // 2, (width + 1) // 2


@every_size
def test_alpha_of_0_keeps_the_fine_image(height: int, width: int) -> None:
    fine, coarse = draw(2, 3, height, width), draw(2, 3, *half(height, width), seed=1)
    assert torch.equal(laplacian_fusion(fine, coarse, torch.zeros(2, 1, height, width)), fine)


@every_size
def test_alpha_of_1_takes_the_low_frequencies_of_the_coarse_image(height: int, width: int) -> None:
    fine, coarse = draw(2, 3, height, width), draw(2, 3, *half(height, width), seed=1)
    fused = laplacian_fusion(fine, coarse, torch.ones(2, 1, height, width))
    torch.testing.assert_close(downsample(fused), coarse, rtol=1e-12, atol=1e-14)
    detail = fine - upsample(downsample(fine), (height, width))
    torch.testing.assert_close(fused - upsample(coarse, (height, width)), detail, rtol=1e-12, atol=1e-14)


def test_known_answer() -> None:
    fine = torch.tensor([[1.0, 2.0], [3.0, 6.0]]).reshape(1, 1, 2, 2)
    coarse = torch.full((1, 1, 1, 1), 5.0)
    alpha = torch.tensor([[0.0, 0.5], [1.0, 0.25]]).reshape(1, 1, 2, 2)
    # The mean of the fine image is 3, so alpha * (5 - 3) is added.
    expected = torch.tensor([[1.0, 3.0], [5.0, 6.5]]).reshape(1, 1, 2, 2)
    assert torch.equal(laplacian_fusion(fine, coarse, alpha), expected)


def test_a_scale_of_the_same_image_adds_nothing() -> None:
    fine = draw(1, 3, 5, 7)
    fused = laplacian_fusion(fine, downsample(fine), draw(1, 1, 5, 7, seed=1))
    torch.testing.assert_close(fused, fine, rtol=1e-12, atol=0)


@every_size
def test_downsampling_undoes_upsampling(height: int, width: int) -> None:
    coarse = draw(2, 3, *half(height, width))
    torch.testing.assert_close(downsample(upsample(coarse, (height, width))), coarse, rtol=1e-12, atol=0)


@every_size
def test_constant_images_stay_as_they_are(height: int, width: int) -> None:
    # Where the last block holds one or two pixels only, a mean over four would darken the border.
    fine, coarse = torch.full((1, 3, height, width), 3.0), torch.full((1, 3, *half(height, width)), 3.0)
    assert torch.equal(downsample(fine), coarse)
    assert torch.equal(upsample(coarse, (height, width)), fine)
    torch.testing.assert_close(laplacian_fusion(fine, coarse, draw(1, 1, height, width).float()), fine)


def test_an_alpha_for_each_channel() -> None:
    fine, coarse, alpha = draw(1, 3, 5, 7), draw(1, 3, 3, 4, seed=1), draw(1, 3, 5, 7, seed=2)
    whole = laplacian_fusion(fine, coarse, alpha)
    for c in range(3):
        one = slice(c, c + 1)
        assert torch.equal(whole[:, one], laplacian_fusion(fine[:, one], coarse[:, one], alpha[:, one]))


def test_half_precision_mean_of_fireflies_does_not_overflow() -> None:
    image = torch.full((1, 3, 5, 7), 6e4, dtype=torch.float16)
    assert torch.equal(downsample(image), image[..., :3, :4])
