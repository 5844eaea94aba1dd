from typing import Any

import kornia
import pytest
import torch
from reference_cases import draw
from torch import Tensor

from mcdenoise.ops import cross_bilateral_filter, cross_bilateral_weights, kernel_conv


def constant(value: float, height: int, width: int, batch: int = 1) -> Tensor:
    return torch.full((batch, 1, height, width), value, dtype=torch.float64)


@pytest.mark.parametrize(("border", "kornia_border"), [("replicate", "replicate"), ("zeros", "constant")])
@pytest.mark.parametrize("normalize", ["softmax", "none"])
@pytest.mark.parametrize(("sigma_color", "sigma_space", "size"), [(0.1, 1.5, 5), (0.02, 4.0, 7)])
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


def test_guides_of_other_dtypes() -> None:
    logits, guide, scale = draw(1, 9, 3, 4).float(), draw(1, 3, 3, 4), constant(2, 3, 4)
    guide.requires_grad_()
    weights = cross_bilateral_weights(logits, [guide, guide.half()], [scale.float(), scale.bfloat16()])
    weights.square().sum().backward()
    assert weights.dtype == torch.float32
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
