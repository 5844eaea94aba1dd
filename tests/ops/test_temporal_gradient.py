"""Properties of temporal gradients, beside their equation."""

import pytest
import torch
from torch import Tensor

from mcdenoise.ops import temporal_gradient

HEIGHT, WIDTH = 24, 36


def light(seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(1, 1, HEIGHT, WIDTH, generator=generator, dtype=torch.float64) + 0.1


def test_a_light_that_goes_out_or_on_is_one_where_it_shone() -> None:
    """It shone on one of two walls; a lamp shines on the other one all the time."""
    left = (torch.arange(WIDTH) < WIDTH // 2).double().expand(1, 1, HEIGHT, WIDTH)
    normal = torch.cat([left, torch.zeros_like(left), 1 - left], 1)
    lit, other = light() * left, light(1) * (1 - left)
    for now, before in ((other, other + lit), (other + lit, other)):
        torch.testing.assert_close(temporal_gradient(now, before, None, None, normal), left)


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


@pytest.mark.parametrize("unit", [2.0**-100, 2.0**127])
def test_no_unit_is_too_dim_or_too_bright(unit: float) -> None:
    """Of light, or of weights. The next power of two is infinite in float32."""
    now, before = (light(seed).float() for seed in (0, 1))
    one = torch.ones_like(now)
    for images in ((unit * now, unit * before, one), (now, before, unit * one)):
        assert torch.equal(temporal_gradient(*images), temporal_gradient(now, before))


def test_a_variance_that_is_too_large_hides_the_change_where_it_is() -> None:
    """Relative to so little light it is infinite, which is 0 times infinity on other surfaces, and in derivatives."""
    left = (torch.arange(WIDTH) < WIDTH // 2).float().expand(1, 1, HEIGHT, WIDTH)
    normal = torch.cat([left, torch.zeros_like(left), 1 - left], 1)
    lit, variance = (1e-15 * light().float()).requires_grad_(), (1e34 * left).requires_grad_()
    found = temporal_gradient(lit, torch.zeros_like(lit), None, variance, normal)
    assert torch.equal(found, 1 - left)
    assert all(slope.isfinite().all() for slope in torch.autograd.grad(found.sum(), (lit, variance)))
