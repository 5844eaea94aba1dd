"""Properties of temporal gradients, beside their equation."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from mcdenoise.ops import temporal_gradient

HEIGHT, WIDTH = 24, 36


def light(seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(1, 1, HEIGHT, WIDTH, generator=generator, dtype=torch.float64) + 0.1


def test_where_nothing_changes_it_is_zero() -> None:
    lit = light() * 10 ** (8 * light(1) - 4)
    assert not temporal_gradient(lit, lit).any()
    assert not temporal_gradient(lit, lit, None, lit.square()).any()
    assert not temporal_gradient(torch.zeros_like(lit), torch.zeros_like(lit)).any()


def test_a_light_that_goes_out_or_on_is_one_where_it_shone() -> None:
    """It shone on one of two walls; a lamp shines on the other one all the time."""
    left = (torch.arange(WIDTH) < WIDTH // 2).double().expand(1, 1, HEIGHT, WIDTH)
    normal = torch.cat([left, torch.zeros_like(left), 1 - left], 1)
    lit, other = light() * left, light(1) * (1 - left)
    for now, before in ((other, other + lit), (other + lit, other)):
        torch.testing.assert_close(temporal_gradient(now, before, None, None, normal), left)


@pytest.mark.parametrize("factor", [0.25, 0.5, 2.0, 10.0])
def test_it_is_the_change_of_the_larger_one(factor: float) -> None:
    found = temporal_gradient(factor * light(), light())
    expected = abs(factor - 1) / max(factor, 1)
    torch.testing.assert_close(found, torch.full_like(found, expected))
    # This holds in any unit.
    torch.testing.assert_close(temporal_gradient(1e6 * factor * light(), 1e6 * light()), found)


def test_signs_cancel_within_a_neighbourhood() -> None:
    """Noise of both signs is no change: what is summed is the difference, not its absolute value."""
    checks = (torch.arange(HEIGHT)[:, None] + torch.arange(WIDTH)) % 2
    flicker = 1 + 0.5 * (2.0 * checks - 1).expand(1, 1, HEIGHT, WIDTH)
    change = temporal_gradient(flicker, 2 - flicker, stratum=2)
    assert change.max() < 1e-12


def test_noise_within_two_standard_errors_is_none() -> None:
    """With normal noise 4.6 % of the strata differ by more than two; without its variance, all of them do."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(2, 1, 1, 120, 120, generator=generator, dtype=torch.float64)
    now, before = 20 + noise
    variance = torch.full_like(now, 2.0)
    found = temporal_gradient(now, before, None, variance, levels=0)
    fraction = (found[..., ::3, ::3] > 0).double().mean()
    # 1600 strata: a standard deviation of 0.5 %.
    assert 0.02 < fraction < 0.07
    assert (temporal_gradient(now, before, levels=0) > 0).all()
    # Filtered, the variance of a mean still is that of the mean.
    wide = (temporal_gradient(now, before, None, variance, levels=1)[..., ::3, ::3] > 0).double().mean()
    assert 0.0 < wide < 0.15
    # A change by three parts in a hundred, in strata of 9 and then 9 of them, is seen through noise of seven.
    assert (temporal_gradient(1.1 * now, before, None, variance, levels=3) > 0.08).double().mean() > 0.95


def test_one_sample_of_a_stratum_stands_for_it() -> None:
    """Those of the other pixels may be anything."""
    sampled = torch.zeros(1, 1, HEIGHT, WIDTH, dtype=torch.float64)
    sampled[..., 2::3, ::3] = 1
    now, before = light(), light(1)
    found = temporal_gradient(now, before, sampled)
    inside = now[..., 2::3, ::3], before[..., 2::3, ::3]
    torch.testing.assert_close(found[..., ::3, ::3], temporal_gradient(*inside, stratum=1))
    torch.testing.assert_close(temporal_gradient(1e3 * (1 - sampled) + now, before, sampled), found)
    assert not temporal_gradient(now, before, 0 * sampled).any()


def test_strata_without_a_sample_take_those_of_their_surface() -> None:
    sampled = torch.zeros(1, 1, HEIGHT, WIDTH, dtype=torch.float64)
    sampled[..., 1, 1] = sampled[..., 1, WIDTH - 2] = 1
    depth = torch.where(torch.arange(WIDTH) < WIDTH // 2, 1.0, 9.0).expand(1, 1, HEIGHT, WIDTH).double()
    kept = 0.1 + 0.4 * (depth == 1).double()
    now = kept * light()
    found = temporal_gradient(now, light(), sampled, None, None, depth)
    torch.testing.assert_close(found, 1 - kept, rtol=1e-10, atol=0)
