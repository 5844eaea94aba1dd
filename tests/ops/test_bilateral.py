from __future__ import annotations

from typing import Any

import kornia
import pytest
import torch
from torch import Tensor

from mcdenoise.ops import cross_bilateral_filter, cross_bilateral_weights, kernel_conv

BORDERS = ["replicate", "zeros", "renormalize"]
every_border = pytest.mark.parametrize("border", BORDERS)


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def constant(value: float, height: int, width: int, batch: int = 1) -> Tensor:
    return torch.full((batch, 1, height, width), value, dtype=torch.float64)


@pytest.mark.parametrize(("border", "kornia_border"), [("replicate", "replicate"), ("zeros", "constant")])
@pytest.mark.parametrize("normalize", ["softmax", "none"])
@pytest.mark.parametrize(("sigma_color", "sigma_space", "size"), [(0.1, 1.5, 5), (0.4, 0.8, 3), (0.02, 4.0, 7)])
def test_plain_weights_are_kornias_joint_bilateral_blur(
    border: Any, kornia_border: str, normalize: Any, sigma_color: float, sigma_space: float, size: int
) -> None:
    image, guide = draw(2, 3, 9, 8), draw(2, 2, 9, 8, seed=1)
    expected = kornia.filters.joint_bilateral_blur(
        image, guide, size, sigma_color, (sigma_space, sigma_space), kornia_border, color_distance_type="l2"
    )
    # exp(-d^2 / (2 sigma^2)) is exp(-f d^2).
    color_scale = constant(1 / (2 * sigma_color**2), 9, 8, batch=2)
    space_scale = constant(1 / (2 * sigma_space**2), 9, 8, batch=2)
    plain = torch.zeros if normalize == "softmax" else torch.ones
    kernel = plain(2, size * size, 9, 8, dtype=torch.float64)
    weights = cross_bilateral_weights(kernel, [guide], [color_scale], space_scale, normalize=normalize, border=border)
    if normalize == "none":
        weights = weights / weights.sum(1, keepdim=True)
    torch.testing.assert_close(kernel_conv(image, weights, border=border), expected, rtol=1e-10, atol=1e-12)


@every_border
def test_eq_5_normalised_is_the_softmax_form(border: Any) -> None:
    logits = 4 * draw(2, 25, 5, 7) - 2
    guides = [draw(2, 3, 5, 7, seed=1), draw(2, 1, 5, 7, seed=2)]
    falloffs = [5 * draw(2, 1, 5, 7, seed=3), 9 * draw(2, 1, 5, 7, seed=4)]
    distance = draw(2, 1, 5, 7, seed=5)
    letter = cross_bilateral_weights(logits.exp(), guides, falloffs, distance, normalize="none", border=border)
    stable = cross_bilateral_weights(logits, guides, falloffs, distance, normalize="softmax", border=border)
    torch.testing.assert_close(letter / letter.sum(1, keepdim=True), stable, rtol=1e-10, atol=1e-14)
    torch.testing.assert_close(stable.sum(1), torch.ones(2, 5, 7, dtype=torch.float64), rtol=1e-12, atol=0)


def test_a_constant_guide_changes_nothing() -> None:
    logits = draw(1, 9, 4, 5)
    weights = cross_bilateral_weights(logits, [constant(0.7, 4, 5)], [constant(1e6, 4, 5)])
    torch.testing.assert_close(weights, logits.softmax(1), rtol=1e-12, atol=0)


@pytest.mark.parametrize("border", ["replicate", "zeros"])
def test_zero_scales_leave_the_softmax_of_the_logits(border: Any) -> None:
    logits, zero = draw(1, 9, 4, 5), constant(0, 4, 5)
    weights = cross_bilateral_weights(logits, [draw(1, 3, 4, 5)], [zero], zero, border=border)
    torch.testing.assert_close(weights, logits.softmax(1), rtol=1e-12, atol=0)


def test_two_pixels_weigh_each_other_alike() -> None:
    ones = torch.ones(1, 25, 6, 7, dtype=torch.float64)
    guide, scale = draw(1, 3, 6, 7), constant(3, 6, 7)
    weights = cross_bilateral_weights(ones, [guide], [scale], constant(0.1, 6, 7), normalize="none")
    taps = weights[0].unflatten(0, (5, 5))
    for dy in range(-2, 3):
        for dx in range(-2, 3):
            to = taps[2 + dy, 2 + dx, max(-dy, 0) : 6 - max(dy, 0), max(-dx, 0) : 7 - max(dx, 0)]
            back = taps[2 - dy, 2 - dx, max(dy, 0) : 6 - max(-dy, 0), max(dx, 0) : 7 - max(-dx, 0)]
            torch.testing.assert_close(to, back, rtol=1e-12, atol=0)


def test_known_weights_of_the_middle_pixel() -> None:
    # exp(-E) is 1/2 at a guide difference of 1 and 1/4 at one pixel's distance.
    guide = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).reshape(1, 1, 1, 3)
    log2 = torch.tensor(2.0, dtype=torch.float64).log()
    arguments = ([guide], [log2.expand(1, 1, 1, 3)], (2 * log2).expand(1, 1, 1, 3))
    ones = torch.ones(1, 9, 1, 3, dtype=torch.float64)
    weights = cross_bilateral_weights(ones, *arguments, normalize="none", border="renormalize")
    expected = torch.tensor([0, 0, 0, 0.125, 1, 0.25, 0, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(weights[0, :, 0, 1], expected, rtol=1e-12, atol=0)
    weights = cross_bilateral_weights(ones.log(), *arguments, border="renormalize")
    torch.testing.assert_close(weights[0, :, 0, 1], expected / 1.375, rtol=1e-12, atol=0)


@every_border
def test_an_edge_in_the_guide_is_not_crossed(border: Any) -> None:
    left = (torch.arange(8) < 4).double().expand(1, 1, 6, 8)
    weights = cross_bilateral_weights(torch.zeros(1, 25, 6, 8).double(), [left], [constant(1e5, 6, 8)], border=border)
    image = 1e4 - 9999 * left
    filtered = kernel_conv(image, weights, border="renormalize")
    torch.testing.assert_close(filtered, image, rtol=1e-12, atol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
def test_no_scale_and_no_logit_overflows(dtype: torch.dtype) -> None:
    logits = (6e4 * (2 * draw(1, 9, 4, 5) - 1)).to(dtype).requires_grad_()
    guide = draw(1, 3, 4, 5, seed=1).to(dtype).requires_grad_()
    scale = constant(6e4, 4, 5).to(dtype).requires_grad_()
    weights = cross_bilateral_weights(logits, [guide], [scale], scale)
    torch.testing.assert_close(weights.sum(1), torch.ones(1, 4, 5, dtype=dtype))
    gradients = torch.autograd.grad((weights * weights.detach().cos()).sum(), [logits, guide, scale])
    assert all(gradient.isfinite().all() for gradient in gradients)


def test_guides_of_other_dtypes() -> None:
    logits, guide, scale = draw(1, 9, 3, 4).float(), draw(1, 3, 3, 4), constant(2, 3, 4)
    guide.requires_grad_()
    weights = cross_bilateral_weights(logits, [guide, guide.half()], [scale.float(), scale.bfloat16()])
    weights.square().sum().backward()
    assert weights.dtype == torch.float32
    assert guide.grad is not None
    assert guide.grad.dtype == torch.float64


@pytest.mark.parametrize("shape", [(0, 3, 4, 5), (1, 0, 4, 5), (1, 3, 0, 5), (1, 3, 4, 0)], ids=str)
def test_empty_images_have_empty_results_and_derivatives(shape: tuple[int, ...]) -> None:
    image = torch.zeros(shape, requires_grad=True)
    batch, _, *size = shape
    kernel, guide, scale = (torch.ones(batch, count, *size, requires_grad=True) for count in (9, 3, 1))
    result = cross_bilateral_filter(image, kernel, [guide], [scale], scale)
    assert result.shape == shape
    for gradient in torch.autograd.grad(result.sum(), (image, kernel, guide, scale)):
        assert not gradient.any()


def test_the_derivative_of_the_distance_scale_keeps_its_precision_under_autocast() -> None:
    logits, upstream = torch.randn(1, 9, 6, 7), torch.randn(1, 9, 6, 7)
    scale = torch.rand(1, 1, 6, 7, requires_grad=True)
    gradients = []
    for autocast in (False, True):
        weights = cross_bilateral_weights(logits, distance_falloff=scale)
        with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
            gradients += torch.autograd.grad(weights, scale, upstream)
    assert torch.equal(*gradients)
