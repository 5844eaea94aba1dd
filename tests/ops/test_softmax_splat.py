"""Tests of ``softmax_splat``: known answers, its limits, and that splats add up."""

from __future__ import annotations

import torch
from torch import Tensor

from mcdenoise.ops import kernel_splat, softmax_splat


def drawn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_it_is_a_splat_over_the_splat_of_ones() -> None:
    image, logits = drawn(2, 3, 6, 5), drawn(2, 25, 6, 5, seed=1)
    weights = torch.exp(logits)
    total = kernel_splat(torch.ones_like(image[:, :1]), weights, border="zeros")
    mean, log_weight = softmax_splat(image, logits)
    torch.testing.assert_close(mean, kernel_splat(image, weights, border="zeros") / total, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(log_weight, torch.log(total), rtol=1e-12, atol=1e-12)


def test_a_pixel_that_is_sent_to_its_neighbour() -> None:
    """Tap 5 of a 3x3 kernel is the pixel to the right."""
    image = torch.tensor([1.0, 2.0, 3.0]).reshape(1, 1, 1, 3)
    logits = torch.zeros(1, 9, 1, 3)
    logits[0, 5, 0, 0] = 200.0
    mean, log_weight = softmax_splat(image, logits)
    assert mean[0, 0, 0, 1] == 1
    assert log_weight[0, 0, 0, 1] == 200
    # A value that arrives elsewhere is not affected.
    torch.testing.assert_close(mean[0, 0, 0, 2], torch.tensor(2.5))


def test_only_differences_of_logits_count() -> None:
    """This holds for exponents whose exponentials no number holds, too."""
    image, logits = drawn(1, 3, 4, 5), drawn(1, 9, 4, 5, seed=1)
    mean, log_weight = softmax_splat(image, logits)
    for offset in (-1e4, 1e4):
        moved, moved_weight = softmax_splat(image, logits + offset)
        # The logits have eps(1e4) = 2e-12 of rounding then.
        torch.testing.assert_close(moved, mean, rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(moved_weight - offset, log_weight, rtol=1e-10, atol=1e-10)


def test_splats_of_several_samples_are_one() -> None:
    """Their means are averaged by their weights, in any order, as if all were splatted at once."""
    images, logits = drawn(4, 3, 4, 5), 30 * drawn(4, 9, 4, 5, seed=1)
    weights = torch.exp(logits)
    total = kernel_splat(torch.cat([images, torch.ones_like(images[:, :1])], 1), weights, border="zeros").sum(0)
    for order in ((0, 1, 2, 3), (3, 1, 0, 2)):
        mean, log_weight = softmax_splat(images[:1] * 0, logits[:1] * 0 - 1e4)
        for each in order:
            new, new_weight = softmax_splat(images[each : each + 1], logits[each : each + 1])
            mean = torch.lerp(mean, new, torch.sigmoid(new_weight - log_weight))
            log_weight = torch.logaddexp(log_weight, new_weight)
        torch.testing.assert_close(mean[0], total[:3] / total[3:], rtol=1e-10, atol=1e-10)
        torch.testing.assert_close(log_weight[0], torch.log(total[3:]), rtol=1e-10, atol=1e-10)


def test_no_image() -> None:
    mean, log_weight = softmax_splat(torch.zeros(0, 3, 4, 5), torch.zeros(0, 9, 4, 5))
    assert (mean.shape, log_weight.shape) == ((0, 3, 4, 5), (0, 1, 4, 5))
