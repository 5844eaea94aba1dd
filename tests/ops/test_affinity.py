"""Properties of the affinity filter, beside its equation."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from mcdenoise.ops import affinity_filter, cross_bilateral_filter

SIZE = (9, 11)


def image(channels: int, seed: int = 0) -> Tensor:
    return torch.rand(1, channels, *SIZE, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


ONE = torch.ones(1, 1, *SIZE, dtype=torch.float64)


def test_it_is_the_bilateral_filter_of_its_features() -> None:
    """The logits are 0, and log c at the centre; taps outside of the image do not count."""
    color, features, bandwidth, center = image(3), image(4, 1), 5 * image(1, 2), image(1, 3)
    logits = torch.zeros(1, 49, *SIZE, dtype=torch.float64)
    logits[:, 24] = center[:, 0].log()
    expected = cross_bilateral_filter(color, logits, [features], [bandwidth], border="renormalize")
    torch.testing.assert_close(affinity_filter(color, features, bandwidth, center), expected)


def test_dilation_is_the_filter_of_every_other_pixel() -> None:
    color, features, bandwidth, center = image(3), image(4, 1), 5 * image(1, 2), image(1, 3)
    found = affinity_filter(color, features, bandwidth, center, kernel_size=3, dilation=2)
    for row in (0, 1):
        for column in (0, 1):
            part = [each[..., row::2, column::2] for each in (color, features, bandwidth, center)]
            torch.testing.assert_close(found[..., row::2, column::2], affinity_filter(*part, kernel_size=3))


def test_features_far_apart_part_the_image() -> None:
    """Nothing of one half is in the other."""
    color = image(3)
    features = torch.where(torch.arange(11) < 5, 0.0, 40.0).expand(1, 2, *SIZE)
    changed = torch.where(torch.arange(11) < 5, color, 100 * color)
    left = [affinity_filter(each, features, ONE, ONE)[..., :5] for each in (color, changed)]
    assert torch.equal(*left)


@pytest.mark.parametrize("center", [0.0, 1e-9, 1e-6])
def test_a_pixel_unlike_its_neighbours_is_unchanged(center: float) -> None:
    color, apart = image(3), 1e3 * torch.arange(99.0).reshape(1, 1, *SIZE)
    torch.testing.assert_close(affinity_filter(color, apart, ONE, center * ONE), color)


def test_equal_features_give_the_mean_of_the_window() -> None:
    color = image(3)
    expected = torch.nn.functional.avg_pool2d(color, 7, 1, 3, count_include_pad=False)
    torch.testing.assert_close(affinity_filter(color, 0 * color, ONE, ONE), expected)


def test_the_frame_before_counts_as_much_as_it_is_known() -> None:
    """One tap each: (c x + k exp(-b d^2) y) / (c + k exp(-b d^2))."""
    color, before, features, there = image(3), image(3, 1), image(2, 2), image(2, 3)
    center, width, known = image(1, 4), image(1, 5), image(1, 6)
    found = affinity_filter(color, features, ONE, center, before, there, width, known, kernel_size=1)
    w = known * torch.exp(-width * (features - there).square().sum(1, keepdim=True))
    torch.testing.assert_close(found, (center * color + w * before) / (center + w))
    # An unknown history is not read, however large it is.
    alone = affinity_filter(color, features, ONE, center)
    unknown = affinity_filter(color, features, ONE, center, 1e30 * before, there, width, 0 * known)
    assert torch.equal(unknown, alone)


def test_flips_and_turns_go_through() -> None:
    inputs = [image(3), image(4, 1), 5 * image(1, 2), image(1, 3)]
    found = affinity_filter(*inputs, dilation=2)
    torch.testing.assert_close(affinity_filter(*(each.flip(-1) for each in inputs), dilation=2), found.flip(-1))
    torch.testing.assert_close(affinity_filter(*(each.mT for each in inputs), dilation=2), found.mT)
