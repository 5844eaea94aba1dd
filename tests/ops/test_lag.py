"""Changes that the test for lag can see, and noise that it must not take for lag."""

from __future__ import annotations

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


def test_a_change_that_noise_hides_is_none() -> None:
    """One per cent, where the standard error of a window is some five."""
    assert lag(exponential(0, 12), 1.01 * exponential(1), VARIANCE).mean() < 0.05


def test_a_change_is_found_where_it_is() -> None:
    history, recent = exponential(0, 12), exponential(1)
    recent[..., :20] = 0
    share = lag(history, recent, VARIANCE)
    assert share[..., :14].min() == 1
    assert share[..., 26:].mean() < 0.05


def test_rare_bright_paths_are_no_lag() -> None:
    """One path in 300 brings 300: most windows of a frame see none, but the history has the noise."""
    g = torch.Generator().manual_seed(0)
    recent = 300.0 * (torch.rand(1, 1, *SIZE, generator=g) < 1 / 300)
    dark = lag(torch.ones(1, 1, *SIZE), recent, torch.zeros(1, 1, *SIZE))
    assert dark.mean() > 0.9
    assert lag(torch.ones(1, 1, *SIZE), recent, torch.full((1, 1, *SIZE), 299.0)).mean() < 0.2


def test_detail_is_no_lag() -> None:
    detail = 10 ** (4 * torch.rand(1, 3, *SIZE, generator=torch.Generator().manual_seed(0)) - 2)
    assert lag(detail, detail, torch.zeros(1, 1, *SIZE)).max() == 0


def test_an_invisible_change_is_no_lag() -> None:
    ones, none = torch.ones(1, 3, *SIZE), torch.zeros(1, 1, *SIZE)
    assert lag(ones, 1.001 * ones, none).max() == 0
    assert lag(ones, 1.01 * ones, none).min() == 1


@pytest.mark.parametrize("exponent", [-30, -10, 10, 30])
def test_exposure_changes_nothing(exponent: int) -> None:
    history, recent = exponential(0, 12), 0.8 * exponential(1)
    share = lag(history, recent, VARIANCE)
    assert 0.1 < share.mean() < 0.9
    scale = 2.0**exponent
    assert torch.equal(lag(history * scale, recent * scale, VARIANCE * scale**2), share)


def test_the_formula_in_one_window() -> None:
    """Five pixels of one row and a window of all of them: 1, 1, 1, 1, 6 against a history of 1.6."""
    recent = torch.tensor([1.0, 1.0, 1.0, 1.0, 6.0], dtype=torch.float64).reshape(1, 1, 1, 5)
    history, variance = (
        torch.full_like(recent, 1.6),
        torch.tensor([1.0, 2.0, 3.0, 4.0, 5.0]).double().reshape(1, 1, 1, 5),
    )
    mean = 2.0
    z2 = (mean - 1.6) ** 2 / (3.0 / 5 + (1e-3 * (mean + 1.6) / 2) ** 2)
    expected = (z2 / 0.4**2 - 1) / 3
    assert 0 < expected < 1
    share = lag(history, recent, variance, threshold=0.4, kernel_size=9)
    torch.testing.assert_close(share, torch.full_like(recent, expected))


def test_windows_at_the_border_count_their_own_pixels() -> None:
    """A corner has 36 of 121 pixels, whose mean has more noise."""
    history, recent = torch.ones(1, 1, 11, 11), torch.full((1, 1, 11, 11), 2.0)
    share = lag(history, recent, torch.full((1, 1, 11, 11), 4.0))
    smallest = (1e-3 * 1.5) ** 2
    for place, count in ((0, 36), (5, 121)):
        z2 = 1 / (4 / count + smallest)
        assert share[0, 0, place, place].item() == pytest.approx(min(max((z2 / 4 - 1) / 3, 0), 1), rel=1e-5)
