"""Tests of means that a map of importance weighs."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.ops import importance_filter, kernel_conv


def drawn(channels: int, height: int, width: int, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.rand(1, channels, height, width, generator=torch.Generator().manual_seed(channels), dtype=dtype)


@pytest.mark.parametrize("kernel_size", [3, 5, 7, 9, 11, 13, 15, 31])
def test_it_is_the_quotient_of_two_box_filters(kernel_size: int) -> None:
    image, importance = drawn(3, 11, 17), 4 * drawn(1, 11, 17)

    def box(image: Tensor) -> Tensor:
        return F.avg_pool2d(image, kernel_size, 1, kernel_size // 2)

    expected = box(importance.exp() * image) / box(importance.exp())
    torch.testing.assert_close(importance_filter(image, importance, kernel_size=kernel_size), expected)


def test_a_map_of_zeros_is_a_box_filter() -> None:
    image = drawn(3, 9, 8)
    expected = F.avg_pool2d(image, 5, 1, 2, count_include_pad=False)
    torch.testing.assert_close(importance_filter(image, torch.zeros(1, 1, 9, 8).double(), kernel_size=5), expected)


def test_it_is_kernel_conv_with_the_softmax_of_the_window() -> None:
    image, importance = drawn(3, 6, 7), 3 * drawn(1, 6, 7)
    window = F.unfold(F.pad(importance, (2, 2, 2, 2), value=-torch.inf), 5).reshape(1, 25, 6, 7)
    expected = kernel_conv(image, torch.softmax(window, 1), border="zeros")
    torch.testing.assert_close(importance_filter(image, importance, kernel_size=5), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.bfloat16])
def test_a_steep_map_picks_the_most_important_pixel_of_each_window(dtype: torch.dtype) -> None:
    """At a cliff of 2e4 no weight of the other side is left, and all weights of a pixel's own side are kept."""
    image = drawn(1, 5, 8, dtype)
    order = torch.randperm(40, generator=torch.Generator().manual_seed(0)).reshape(1, 1, 5, 8)
    importance = (500.0 * order - 1e4).to(dtype)
    _, places = F.max_pool2d(order.double(), 3, 1, 1, return_indices=True)
    expected = image.flatten()[places.flatten()].reshape(image.shape)
    assert torch.equal(importance_filter(image, importance, kernel_size=3), expected)


def test_a_window_far_below_the_highest_of_the_map_keeps_its_weights() -> None:
    image, importance = drawn(3, 6, 20, torch.float32), 2 * drawn(1, 6, 20, torch.float32)
    raised = importance + torch.where(torch.arange(20) < 10, 0.0, 1e4)
    expected = importance_filter(image[..., :10], importance[..., :10], kernel_size=5)
    torch.testing.assert_close(importance_filter(image, raised, kernel_size=5)[..., :8], expected[..., :8])


def test_a_lamp_of_hardly_any_weight_is_seen_as_far_as_its_weight_goes() -> None:
    image, importance = torch.ones(1, 1, 1, 3), torch.tensor([0.0, 50.0, 50.0]).reshape(1, 1, 1, 3)
    image[..., 0] = 1e30
    expected = 1 + 1e30 * torch.tensor(-50.0).double().exp() / 2
    found = importance_filter(image, importance, kernel_size=3)[0, 0, 0, 1]
    torch.testing.assert_close(found.double(), expected, rtol=1e-6, atol=0)


def test_second_derivatives_of_a_flat_map() -> None:
    """All importances are equal, where a maximum has a kink that the result does not have."""
    image, importance = drawn(2, 3, 3).requires_grad_(), torch.zeros(1, 1, 3, 3).double().requires_grad_()

    def filtered(image: Tensor, importance: Tensor) -> Tensor:
        return importance_filter(image, importance, kernel_size=3)

    assert torch.autograd.gradcheck(filtered, (image, importance))
    assert torch.autograd.gradgradcheck(filtered, (image, importance))


@pytest.mark.parametrize("scale", [1e3, 1e4, 1e30])
def test_derivatives_of_a_steep_map_are_finite(scale: float) -> None:
    image = drawn(3, 6, 7, torch.float32).requires_grad_()
    importance = (scale * (2 * drawn(1, 6, 7, torch.float32) - 1)).requires_grad_()
    result = importance_filter(image, importance, kernel_size=5).square().sum()
    first = torch.autograd.grad(result, (image, importance), create_graph=True)
    second = torch.autograd.grad(sum(each.square().sum() for each in first), (image, importance))
    assert all(each.isfinite().all() for each in (*first, *second))
    # Each window has one pixel whose weight is 1, which its square is the square of.
    torch.testing.assert_close(first[0].sum(), 2 * importance_filter(image, importance, kernel_size=5).sum())


@pytest.mark.parametrize("kernel_size", [1, 4, -3])
def test_a_window_without_neighbours_or_centre_is_refused(kernel_size: int) -> None:
    with pytest.raises(ValueError, match=rf"kernel_size: .*{kernel_size}"):
        importance_filter(drawn(3, 4, 5), drawn(1, 4, 5), kernel_size=kernel_size)
