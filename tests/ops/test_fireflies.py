import pytest
import torch
from torch import Tensor

from mcdenoise.ops import clamp_fireflies

DTYPES = [torch.float64, torch.float32, torch.bfloat16, torch.float16]


def noise(*size: int, seed: int = 0) -> Tensor:
    """Noise of which nothing reaches the limit."""
    return 0.5 + torch.rand(*size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_the_unit_does_not_matter() -> None:
    image = noise(1, 3, 9, 9)
    image[..., 4, 4] = 1e4
    for factor in (2.0**-60, 2.0**40):
        assert torch.equal(clamp_fireflies(image * factor), clamp_fireflies(image) * factor)
        single = image.float()
        assert torch.equal(clamp_fireflies(single * factor), clamp_fireflies(single) * factor)
    torch.testing.assert_close(clamp_fireflies(image * 0.3), clamp_fireflies(image) * 0.3, rtol=1e-12, atol=0)


def test_a_limit_beyond_the_range_of_the_dtype_makes_no_nan() -> None:
    image = torch.zeros(1, 3, 9, 9, requires_grad=True)
    result = clamp_fireflies(image, limit=1e39)
    assert torch.equal(result, image)
    (gradient,) = torch.autograd.grad(result.sum(), image)
    assert gradient.unique().tolist() == [1]


@pytest.mark.parametrize("dtype", DTYPES[:3], ids=str)
def test_dark_neighbours_of_a_very_bright_pixel_are_not_lost(dtype: torch.dtype) -> None:
    """The bright pixel's window sums 1e-4 alone, and in every window beside it the sum has room."""
    image = torch.full((1, 3, 7, 9), 1e-4, dtype=dtype)
    image[..., 3, 4] = 1e30
    result = clamp_fireflies(image)
    expected = torch.full_like(image, 1e-4)
    expected[..., 3, 4] = 1.5e-3
    torch.testing.assert_close(result, expected, rtol=8 * torch.finfo(dtype).eps, atol=0)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_the_largest_numbers_do_not_overflow(dtype: torch.dtype) -> None:
    largest = torch.finfo(dtype).max
    image = torch.full((1, 64, 9, 9), largest, dtype=dtype, requires_grad=True)
    result = clamp_fireflies(image)
    assert torch.equal(result, image)
    (gradient,) = torch.autograd.grad(result.sum(), image)
    assert gradient.unique().tolist() == [1]
    alone = torch.ones(1, 64, 9, 9, dtype=dtype)
    alone[..., 4, 4] = largest
    torch.testing.assert_close(clamp_fireflies(alone)[..., 4, 4], torch.full((1, 64), 15.0, dtype=dtype))


def test_autocast_does_not_round() -> None:
    image = noise(1, 3, 9, 9).float()
    image[..., 4, 4] = 1e4
    with torch.autocast("cpu", torch.bfloat16):
        result = clamp_fireflies(image)
    assert torch.equal(result, clamp_fireflies(image))
