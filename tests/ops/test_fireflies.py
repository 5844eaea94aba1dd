from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from mcdenoise.ops import clamp_fireflies

DTYPES = [torch.float64, torch.float32, torch.bfloat16, torch.float16]


def noise(*size: int, seed: int = 0) -> Tensor:
    """Noise of which nothing reaches the limit."""
    return 0.5 + torch.rand(*size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize(
    ("place", "others"),
    # The mean is over the pixels that exist: 48, at the border 27 and in the corner 15 of them.
    [((6, 7), 48), ((0, 7), 27), ((6, 14), 27), ((0, 0), 15), ((12, 14), 15)],
)
def test_a_firefly_is_brought_to_the_limit(place: tuple[int, int], others: int) -> None:
    image = torch.ones(1, 3, 13, 15, dtype=torch.float64)
    image[:, :, *place] = 1e4
    # A neighbour that counts, and says how many there are.
    row, column = (at - 1 if at else 1 for at in place)
    image[:, :, row, column] = 4
    result = clamp_fireflies(image)[:, :, *place]
    torch.testing.assert_close(result, torch.full_like(result, 15 * (others + 3) / others), rtol=1e-12, atol=0)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_nothing_but_the_firefly_changes(dtype: torch.dtype) -> None:
    image = noise(2, 3, 11, 12).to(dtype)
    image[1, :, 5, 5] = 6e4
    result = clamp_fireflies(image)
    changed = (result != image).any(1)
    assert changed.nonzero().tolist() == [[1, 5, 5]]
    assert result.dtype == dtype


def test_the_hue_is_kept() -> None:
    image = noise(1, 3, 9, 9)
    image[0, :, 4, 4] = torch.tensor([1e4, 3e4, 0.0])
    red, green, blue = clamp_fireflies(image)[0, :, 4, 4].tolist()
    assert green == pytest.approx(3 * red, rel=1e-12)
    assert blue == 0
    assert (red + green) / 3 < 15 * 1.5


def test_the_unit_does_not_matter() -> None:
    image = noise(1, 3, 9, 9)
    image[..., 4, 4] = 1e4
    for factor in (2.0**-60, 2.0**40):
        assert torch.equal(clamp_fireflies(image * factor), clamp_fireflies(image) * factor)
        single = image.float()
        assert torch.equal(clamp_fireflies(single * factor), clamp_fireflies(single) * factor)
    torch.testing.assert_close(clamp_fireflies(image * 0.3), clamp_fireflies(image) * 0.3, rtol=1e-12, atol=0)


def test_an_infinite_limit_changes_nothing() -> None:
    image = noise(1, 3, 9, 9)
    image[..., 4, 4] = 1e30
    assert torch.equal(clamp_fireflies(image, limit=math.inf), image)


def test_a_limit_beyond_the_range_of_the_dtype_makes_no_nan() -> None:
    image = torch.zeros(1, 3, 9, 9, requires_grad=True)
    result = clamp_fireflies(image, limit=1e39)
    assert torch.equal(result, image)
    (gradient,) = torch.autograd.grad(result.sum(), image)
    assert gradient.unique().tolist() == [1]


def test_black_neighbours_do_not_count() -> None:
    image = torch.zeros(1, 3, 15, 15, dtype=torch.float64)
    image[..., 7, 7] = 1e4
    image[..., 5, 7] = 1.0
    image[..., 8, 9] = 2.0
    result = clamp_fireflies(image)
    assert result[0, :, 7, 7].tolist() == pytest.approx([22.5] * 3, rel=1e-12)
    result[..., 7, 7] = 1e4
    assert torch.equal(result, image)


def test_an_image_of_one_pixel_or_none_has_no_neighbours() -> None:
    for size in ((1, 3, 1, 1), (2, 3, 0, 4), (0, 3, 5, 5), (1, 0, 5, 5)):
        image = torch.full(size, 1e9)
        assert torch.equal(clamp_fireflies(image), image)


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


def test_gradients_are_finite_everywhere() -> None:
    for value in (0.0, 1.0, 1e4, 1e15):
        image = torch.zeros(1, 3, 5, 5)
        image[..., 2, 2] = value
        image.requires_grad_()
        (gradient,) = torch.autograd.grad(clamp_fireflies(image).sum(), image)
        assert gradient.isfinite().all()


def test_autocast_does_not_round() -> None:
    image = noise(1, 3, 9, 9).float()
    image[..., 4, 4] = 1e4
    with torch.autocast("cpu", torch.bfloat16):
        result = clamp_fireflies(image)
    assert torch.equal(result, clamp_fireflies(image))
