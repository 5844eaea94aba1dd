"""Where an operator and a primitive of kornia compute the same thing, they agree; docs/kornia.md lists the pairs."""

import kornia
import torch
from reference_cases import draw

from mcdenoise.ops import downsample, kernel_splat, luminance_moments, motion_from_position, upsample


def test_the_same_kernel_everywhere_splats_as_filter2d_with_the_kernel_turned_around() -> None:
    image, kernel = draw(2, 3, 7, 9), draw(1, 3, 5, seed=1)[:, :, :3].contiguous()
    everywhere = kernel.reshape(1, 9, 1, 1).expand(2, -1, 7, 9)
    expected = kornia.filters.filter2d(image, kernel.flip(1, 2), border_type="constant")
    torch.testing.assert_close(kernel_splat(image, everywhere, border="zeros"), expected, rtol=1e-12, atol=1e-12)


def test_downsampling_an_even_size_is_resize_by_area() -> None:
    image = draw(2, 3, 8, 10)
    expected = kornia.geometry.transform.resize(image, (4, 5), interpolation="area")
    torch.testing.assert_close(downsample(image), expected, rtol=1e-12, atol=0)


def test_upsampling_is_resize_by_nearest() -> None:
    image = draw(2, 3, 4, 5)
    expected = kornia.geometry.transform.resize(image, (8, 10), interpolation="nearest")
    assert torch.equal(upsample(image, (8, 10)), expected)


def test_luminance_is_grayscale_with_the_weights_of_rec_709() -> None:
    light = draw(2, 3, 6, 5)
    weights = torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64)
    expected = kornia.color.rgb_to_grayscale(light, rgb_weights=weights)
    torch.testing.assert_close(luminance_moments(light)[:, :1], expected, rtol=1e-12, atol=0)


def test_motion_is_where_transform_points_puts_the_positions() -> None:
    position, matrix = draw(2, 3, 4, 6), torch.eye(4, dtype=torch.float64) + 0.1 * draw(2, 4, 4, seed=1)
    points = position.flatten(2).mT  # (2, 24, 3)
    # kornia's matrices are for column vectors.
    clip = kornia.geometry.linalg.transform_points(matrix.mT, points)
    place = (clip[..., :2] + 1) / 2 * torch.tensor([6.0, 4.0], dtype=torch.float64)
    pixel = kornia.geometry.grid.create_meshgrid(4, 6, normalized_coordinates=False, dtype=torch.float64)
    expected = (place.reshape(2, 4, 6, 2) - pixel - 0.5).permute(0, 3, 1, 2)
    torch.testing.assert_close(motion_from_position(position, matrix), expected, rtol=1e-9, atol=1e-9)
