"""What the test for lag can see, and what it must not take for lag."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from mcdenoise.ops import history_lag

SIZE = (40, 40)


def exponential(seed: int, frames: int = 1) -> Tensor:
    """The mean of some frames of noise as path tracing has it: mean 1, deviation 1, a long tail."""
    g = torch.Generator().manual_seed(seed)
    return -torch.log(torch.rand(frames, 3, *SIZE, generator=g).clamp_min(1e-7)).mean(0, keepdim=True)


def test_noise_is_no_lag() -> None:
    shares = [history_lag(exponential(seed, 12), exponential(100 + seed)) for seed in range(10)]
    given_up = torch.cat(shares).mean().item()
    # Of normal noise 0.3 % of the windows are 3 standard errors off, and give up a few per cent; the tail adds to that.
    assert 0 <= given_up < 1e-3


@pytest.mark.parametrize("change", [0.0, 0.1, 0.5, 4.0])
def test_a_change_of_the_light_is_lag(change: float) -> None:
    assert history_lag(exponential(0, 12), change * exponential(1)).mean() > (0.99 if change != 0.5 else 0.9)


def test_a_change_that_noise_hides_is_none() -> None:
    """One per cent, where the standard error of a window is some seven."""
    assert history_lag(exponential(0, 12), 1.01 * exponential(1)).mean() < 1e-2


def test_a_change_is_found_where_it_is() -> None:
    history, recent = exponential(0, 12), exponential(1)
    recent[..., :20] = 0
    share = history_lag(history, recent)
    assert share[..., :16].min() == 1
    assert share[..., 24:].max() < 0.2


def test_one_outlier_is_no_lag() -> None:
    history, recent = torch.ones(1, 3, *SIZE), exponential(1)
    recent[..., 20, 20] = 1e6
    assert history_lag(history, recent)[..., 17:24, 17:24].max() == 0


def test_detail_is_no_lag() -> None:
    detail = 10 ** (4 * torch.rand(1, 3, *SIZE, generator=torch.Generator().manual_seed(0)) - 2)
    assert history_lag(detail, detail).max() == 0


def test_what_no_eye_sees_is_no_lag() -> None:
    ones = torch.ones(1, 3, *SIZE)
    assert history_lag(ones, 1.002 * ones).max() == 0
    assert history_lag(ones, 1.01 * ones).min() == 1


@pytest.mark.parametrize("exponent", [-60, -10, 10, 60])
def test_exposure_changes_nothing(exponent: int) -> None:
    history, recent = exponential(0, 12), 0.7 * exponential(1)
    share = history_lag(history, recent)
    assert 0.1 < share.mean() < 0.9
    assert torch.equal(history_lag(history * 2.0**exponent, recent * 2.0**exponent), share)


def test_the_formula_in_one_window() -> None:
    """Five pixels of one row and a window of all of them: 1, 1, 1, 1, 6 against a history of 1.6."""
    recent = torch.tensor([1.0, 1.0, 1.0, 1.0, 6.0], dtype=torch.float64).reshape(1, 1, 1, 5)
    history = torch.full_like(recent, 1.6)
    mean = 2.0
    variance = (4 * 1.0 + 16.0) / 5
    z2 = (mean - 1.6) ** 2 / (variance / 5 + (1e-3 * (mean + 1.6) / 2) ** 2)
    expected = (z2 / 0.3**2 - 1) / 3
    assert 0 < expected < 1
    share = history_lag(history, recent, threshold=0.3, kernel_size=9)
    torch.testing.assert_close(share, torch.full_like(recent, expected))
