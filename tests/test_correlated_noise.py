"""How much noise a frame has, and whether that of neighbouring pixels is correlated."""

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.noise import noise_is_spread, noise_of

HEIGHT, WIDTH = 192, 320
ROWS, COLUMNS = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")


def texture(kind: str) -> Tensor:
    """Albedo of checks, in colors or in greys, or of one color everywhere."""
    colors = {
        "colored": [[0.8, 0.3, 0.1], [0.2, 0.5, 0.6], [0.6, 0.6, 0.2]],
        "grey": [[0.8] * 3, [0.15] * 3, [0.4] * 3],
        "plain": [[0.6, 0.4, 0.3]] * 3,
    }
    return torch.tensor(colors[kind])[(ROWS // 5 + COLUMNS // 7) % 3].permute(2, 0, 1)[None]


def light(seed: int) -> Tensor:
    """One sample a pixel of smooth light: most paths find nothing, few find a lamp, and those are bright."""
    generator = torch.Generator().manual_seed(seed)
    smooth = 1 + 0.5 * torch.sin(ROWS / 40) * torch.cos(COLUMNS / 50)
    drawn, bright = torch.rand(2, HEIGHT, WIDTH, generator=generator)
    # A Pareto distribution, in nearly the same color for the whole path.
    path = torch.where(drawn < 0.4, 2 * (bright.clamp_min(1e-6) ** (-1 / 2.5) - 1), torch.tensor(0.05))
    tint = (1 + 0.05 * torch.randn(1, 3, HEIGHT, WIDTH, generator=generator)).clamp(0.5, 1.5)
    return smooth * path * tint * torch.tensor([1, 0.9, 0.8]).reshape(3, 1, 1)


def through_film(color: Tensor) -> Tensor:
    """Mitsuba's default: a Gaussian of half a pixel; samples lie anywhere in their pixel, which widens it."""
    weights = torch.exp(-(torch.arange(-2.0, 3) ** 2) / (2 * (0.5**2 + 1 / 12)))
    weights = (weights[:, None] * weights / weights.sum() ** 2).expand(3, 1, 5, 5)
    return F.conv2d(F.pad(color, [2] * 4, mode="circular"), weights, groups=3)


@pytest.mark.parametrize("kind", ["colored", "grey", "plain"])
def test_correlated_noise_is_detected(kind: str) -> None:
    albedo = texture(kind)
    color = albedo * light(0)
    assert not noise_is_spread(color, albedo)
    assert noise_is_spread(through_film(color), albedo)
    assert noise_is_spread(through_film(color) * 1e-6, None) or kind != "plain"
    # Every second pixel of every second row has hardly any noise in common.
    assert not noise_is_spread(through_film(color)[..., ::2, ::2], albedo[..., ::2, ::2])


@pytest.mark.parametrize("kind", ["colored", "grey", "plain"])
def test_a_normal_shows_correlation_of_little_noise(kind: str) -> None:
    torch.manual_seed(0)
    albedo, normal = texture(kind), F.normalize(torch.tensor([0.2, 0.3, 1.0]), dim=0).reshape(1, 3, 1, 1)
    normal = normal.expand(1, 3, HEIGHT, WIDTH)
    smooth = 1 + 0.5 * torch.sin(ROWS / 40) * torch.cos(COLUMNS / 50)
    # As of a hundred samples a pixel.
    color = albedo * smooth * (1 + 0.12 * torch.randn(1, 1, HEIGHT, WIDTH)).clamp_min(0.5)
    assert noise_is_spread(through_film(color), albedo, normal)
    assert not noise_is_spread(through_film(color), albedo)
    assert not noise_is_spread(color, albedo, normal)
    # An encoded normal changes as little.
    assert noise_is_spread(through_film(color), albedo, normal / 2 + 0.5)
    assert not noise_is_spread((albedo * smooth).expand(1, 3, -1, -1), albedo, normal)
    # A normal that is even nowhere tells nothing, and all pixels count.
    assert noise_is_spread(through_film(albedo * light(0)), albedo, torch.rand_like(normal))
    assert not noise_is_spread(albedo * light(0), albedo, torch.rand_like(normal))


def test_the_level_of_independent_noise() -> None:
    torch.manual_seed(2)
    deviation = 0.1
    light = 1 + deviation * torch.randn(2, 1, 800, 800, dtype=torch.float64)
    level, spread = noise_of(light.expand(2, 3, -1, -1))
    # The mean of a normal distribution's modulus is sqrt(2 / pi); `a - 2 c + e` has six times a pixel's variance, and
    # the weights of `m`, 1, 1, 2, 1 and 1, have the sum 6 and the sum of squares 8: the mean of 1 / m is larger by the
    # square of its relative deviation.
    expected = deviation * 6**0.5 * (2 / torch.pi) ** 0.5 / 6 * (1 + 8 * deviation**2 / 36)
    assert level.shape == spread.shape == (2, 1, 1, 1)
    # There are 160,000 differences, some 50,000 of them independent; their deviation is 0.76 of their mean.
    assert level.flatten().tolist() == pytest.approx([expected] * 2, rel=5 * 0.76 / 50_000**0.5)
    assert spread.flatten().tolist() == [0, 0]


@pytest.mark.parametrize("share", [0.0, 0.3, 0.6])
@pytest.mark.parametrize("background", [0.0, 0.7])
def test_pixels_without_any_noise_do_not_count(share: float, background: float) -> None:
    albedo, normal = torch.ones(1, 3, HEIGHT, WIDTH), torch.zeros(1, 3, HEIGHT, WIDTH)
    for color, spread in ((light(0), 0), (through_film(light(0)), 1)):
        noise = noise_of(color, albedo, normal)
        covered = torch.where(share * HEIGHT > ROWS, background, color)
        found = noise_of(covered, albedo, normal)
        assert float(found.level) == pytest.approx(float(noise.level), rel=0.1)
        assert float(found.spread) == float(noise.spread) == spread
