"""Changes that the test for lag can see, and noise that it must not take for lag."""

import functools
import math

import pytest
import torch
from torch import Tensor

from mcdenoise.ops import history_lag

SIZE = (40, 40)
# 121 pixels a window.
lag = functools.partial(history_lag, kernel_size=11)
# The variance is that of the mean of three channels, each of deviation 1.
VARIANCE = torch.full((1, 1, *SIZE), 1 / 3)


def exponential(seed: int, frames: int = 1) -> Tensor:
    """The mean of some frames of noise as path tracing has it: mean 1, deviation 1, a long tail."""
    g = torch.Generator().manual_seed(seed)
    return -torch.log(torch.rand(frames, 3, *SIZE, generator=g).clamp_min(1e-7)).mean(0, keepdim=True)


def test_noise_is_no_lag() -> None:
    shares = [lag(exponential(seed, 12), exponential(100 + seed), VARIANCE) for seed in range(10)]
    given_up = torch.cat(shares).mean().item()
    # z is normal, with 13/12 of the variance, since the history has noise too: the mean fraction, by integration.
    z = torch.linspace(2, 12, 100_001, dtype=torch.float64)
    density = 2 * torch.exp(-(z**2) / 2 / (13 / 12)) / math.sqrt(2 * math.pi * 13 / 12)
    expected = torch.trapezoid(density * ((z**2 / 4 - 1) / 3).clamp(0, 1), z).item()
    assert 0.005 < expected < 0.02
    # 16,000 pixels are some 130 windows that overlap little.
    assert 0 < given_up < 2 * expected


@pytest.mark.parametrize("change", [0.0, 0.1, 0.5, 4.0])
def test_a_change_of_the_light_is_lag(change: float) -> None:
    assert lag(exponential(0, 12), change * exponential(1), VARIANCE).mean() > 0.99


def test_rare_bright_paths_are_no_lag() -> None:
    """One path in 300 brings 300: most windows of a frame see none, but the history has the noise."""
    g = torch.Generator().manual_seed(0)
    recent = 300.0 * (torch.rand(1, 1, *SIZE, generator=g) < 1 / 300)
    dark = lag(torch.ones(1, 1, *SIZE), recent, torch.zeros(1, 1, *SIZE))
    assert dark.mean() > 0.9
    assert lag(torch.ones(1, 1, *SIZE), recent, torch.full((1, 1, *SIZE), 299.0)).mean() < 0.2


@pytest.mark.parametrize("light", [1e-14, 1e-16, 1e-19, 1e-21])
def test_the_derivative_in_the_dark_beside_a_lamp_is_finite(light: float) -> None:
    """Where a light goes out that is so much darker than the lamp, z is large, and so is its derivative."""
    history, variance = torch.full((1, 1, 8, 8), light), torch.zeros(1, 1, 8, 8)
    recent = torch.zeros_like(history)
    history[..., 0, 0] = recent[..., 0, 0] = 1
    images = [each.requires_grad_() for each in (history, recent, variance)]
    slopes = torch.autograd.grad(history_lag(*images).sum(), images)
    assert all(slope.isfinite().all() for slope in slopes)
