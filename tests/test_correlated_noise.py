"""Whether the noise of neighbouring pixels is correlated."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise import ops
from mcdenoise.noise import noise_is_spread
from mcdenoise.ops._steps.noise import second_differences

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
@pytest.mark.parametrize("seed", range(3))
def test_correlated_noise_is_detected(kind: str, seed: int) -> None:
    albedo = texture(kind)
    color = albedo * light(seed)
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
    # A normal that is even nowhere tells nothing, so that the noise has to be stronger.
    assert not noise_is_spread(through_film(color), albedo, torch.rand_like(normal))
    assert noise_is_spread(through_film(albedo * light(0)), albedo, torch.rand_like(normal))


def test_the_correlation_of_many_samples_through_a_tent_is_recognised() -> None:
    torch.manual_seed(1)
    # The weights of a tent of radius 1 in its own pixel and the next have the autocorrelation 1/6, 2/3, 1/6; so have
    # two taps whose product is 1/6 and whose sum is 1.
    near = (1 + (1 / 3) ** 0.5) / 2
    taps = torch.tensor([near, 1 - near])
    assert float(taps.prod()) == pytest.approx(1 / 6)
    noise = torch.randn(1, 1, HEIGHT, WIDTH)
    through_tent = F.conv2d(F.pad(noise, (1, 0, 1, 0), mode="circular"), (taps[:, None] * taps)[None, None])
    albedo, normal = texture("grey"), torch.tensor([0.0, 0.0, 1.0]).reshape(1, 3, 1, 1).expand(1, 3, HEIGHT, WIDTH)
    assert noise_is_spread(albedo * (1 + 0.1 * through_tent), albedo, normal)
    assert not noise_is_spread(albedo * (1 + 0.1 * noise), albedo, normal)


def test_an_image_without_noise_has_no_correlated_noise() -> None:
    smooth = (2 + torch.sin(ROWS / 9) * torch.cos(COLUMNS / 7)).expand(1, 3, -1, -1)
    assert not noise_is_spread(smooth, None)
    assert not noise_is_spread(torch.zeros(1, 3, HEIGHT, WIDTH), None)
    assert not noise_is_spread(torch.ones(1, 3, 3, 4), None)


@pytest.mark.parametrize("channels", [0, 4])
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_compiled_differences_are_those_of_the_reference(channels: int, turned: bool, dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(3)
    image = torch.rand(2, 19, 23, generator=generator, dtype=dtype)
    features = torch.rand(2, channels, 19, 23, generator=generator, dtype=dtype).cumsum(-1) * 0.45
    if turned:
        image, features = image.mT, features.mT
    found = []
    for backend in ("torch", "numba"):
        with ops.use(backend):
            found.append(second_differences(image, features if channels else None, 0.4))
    for one, other in zip(*found, strict=True):
        # Differences and means of five values of at most 1, relative to a mean that is hardly below 0.1.
        torch.testing.assert_close(one, other, rtol=0, atol=100 * torch.finfo(dtype).eps)
    most = 2 * image.shape[1] * (image.shape[2] - 4)
    assert len(found[0][0]) == most if channels == 0 else 0 < len(found[0][0]) < most
