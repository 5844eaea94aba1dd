"""Properties of block regression, beside its equation."""

import torch
import torch.nn.functional as F
from reference_cases import draw
from torch import Tensor

from mcdenoise.ops import block_regression


def scene() -> Tensor:
    """Normals of a curved wall, and positions on it, far from the origin."""
    rows, columns = torch.meshgrid(torch.arange(40) / 20.0, torch.arange(50) / 20.0, indexing="ij")
    depth = 1000 + (0.7 * columns).sin() + 0.2 * rows.square()
    normal = F.normalize(torch.stack([(3 * rows).sin(), (2 * columns).cos(), torch.ones_like(rows)]), dim=0)
    return torch.cat([normal, torch.stack([100 + columns, rows - 50, depth])])[None].double()


def test_an_image_linear_in_the_features_is_returned() -> None:
    """Only the ridge, 1e-8, makes a difference; in float32 that is less than a rounding."""
    features, weights = scene(), draw(3, 6) - 0.5
    image = 2 + torch.einsum("cf,bfhw->bchw", weights, features - features.mean((2, 3), keepdim=True))
    for offset in ((0, 0), (5, 17)):
        found = block_regression(image, features, offset=offset)
        torch.testing.assert_close(found, image, rtol=0, atol=1e-5)
        plain = block_regression(image, draw(1, 6, 40, 50), offset=offset)
        assert (plain - image).abs().max() > 0.1


def test_squares_are_fitted_wherever_the_origin_is() -> None:
    """A parabola of a position, which is not linear in it."""
    place = (torch.arange(64, dtype=torch.float64) / 64).expand(1, 1, 32, 64)
    image = 1 + (place - 0.3).square()
    spread = (2.0**-5 * (32**2 - 1) ** 0.5 / 12**0.5) / 2
    for origin in (0.0, 1e2, 1e4, 1e5):
        found = block_regression(image, origin + place, squares=1)
        # A feature that deviates by 1e-7 of its size counts half, and all others lose less. Each function is off by
        # that of its deviation, which is no more than the image's, so that no pixel is off by more than three of both.
        lost = 1e-8 + (1e-7 * (origin + 1) / spread) ** 2
        assert (found - image).abs().max() < 6 * lost * image.std()
        assert (block_regression(image, origin + place) - image).abs().max() > 1e-2


def test_features_that_say_nothing_new_change_nothing() -> None:
    """Multiples, sums, constants and zeros, which leave the normal equations singular; and another unit."""
    image, features = draw(1, 3, 40, 50), draw(1, 2, 40, 50, seed=1)
    expected = block_regression(image, features)
    flat, total = torch.full_like(features[:, :1], 0.8), features.sum(1, keepdim=True)
    redundant = torch.cat([features, -3 * features, flat, 0 * flat, total, features + 5], 1)
    torch.testing.assert_close(block_regression(image, redundant), expected, rtol=0, atol=1e-7)
    torch.testing.assert_close(block_regression(image, 1e4 * features), expected, rtol=1e-12, atol=0)


def test_a_flat_wall_is_its_mean() -> None:
    """The rounding of a constant normal in float32, 1e-7 of it, is no feature."""
    image = draw(1, 3, 32, 32).float()
    normal = torch.tensor([0.6, 0.0, -0.8]).reshape(1, 3, 1, 1).expand(1, 3, 32, 32)
    mean = image.double().mean((2, 3), keepdim=True).float().expand_as(image)
    assert torch.equal(block_regression(image, normal), mean)
    rounded = normal * (1 + 2.0**-25 * (2 * draw(1, 3, 32, 32) - 1))
    found = block_regression(image.double(), rounded)
    assert (found - mean).abs().max() < 0.1 * (block_regression(image, draw(1, 2, 32, 32)) - mean).abs().max()
