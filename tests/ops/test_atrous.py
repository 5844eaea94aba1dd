"""Properties of the a-trous transform and of the variance of moments, beside their equations."""

from __future__ import annotations

import torch
from kornia.filters import filter2d_separable

from mcdenoise.ops import atrous, luminance_moments, moments_variance


def test_without_edges_it_is_the_kernel_of_b_splines() -> None:
    """Noise that is taken for anything stops nothing; inside of the border the weights are those of the kernel."""
    light = torch.rand(1, 3, 12, 14, dtype=torch.float64)
    variance = torch.full((1, 1, 12, 14), 1e20, dtype=torch.float64)
    filtered, remaining = atrous(light, variance)
    kernel = torch.tensor([[1.0, 4, 6, 4, 1]], dtype=torch.float64) / 16
    expected = filter2d_separable(light, kernel, kernel)
    torch.testing.assert_close(filtered[..., 2:-2, 2:-2], expected[..., 2:-2, 2:-2])
    # Eq. 2: the squares of (1, 4, 6, 4, 1) sum to 70 of 256, along each axis.
    torch.testing.assert_close(remaining[..., 2:-2, 2:-2], variance[..., 2:-2, 2:-2] * (70 / 256) ** 2)


def test_taps_lie_a_step_apart() -> None:
    light = torch.zeros(1, 3, 17, 17)
    light[..., 8, 8] = 1
    for step in (1, 2, 4):
        reached = atrous(light, torch.full((1, 1, 17, 17), 1e10), step=step)[0][0, 0].nonzero()
        places = [8 + step * offset for offset in range(-2, 3)]
        assert reached.tolist() == [[row, column] for row in places for column in places]


def test_luminance_stops_by_its_deviation() -> None:
    """Two halves that differ by one: at a deviation of a quarter, sigma_l of 4 makes it exp(-1) for each tap across."""
    light = torch.zeros(1, 3, 1, 8, dtype=torch.float64)
    light[..., 4:] = 1
    filtered, _ = atrous(light, torch.full((1, 1, 1, 8), 1 / 16, dtype=torch.float64))
    across = torch.tensor(4 / 16 + 1 / 16, dtype=torch.float64) * torch.exp(torch.tensor(-1.0, dtype=torch.float64))
    expected = across / (11 / 16 + across)
    torch.testing.assert_close(filtered[0, 0, 0, 3], expected)


def test_a_slope_is_no_edge_and_a_step_is() -> None:
    light = torch.rand(1, 3, 8, 32)
    variance = torch.full((1, 1, 8, 32), 1e10)
    slope = (torch.arange(32) * 0.5 + 2).expand(1, 1, 8, 32)
    alone, along = atrous(light, variance)[0], atrous(light, variance, None, slope)[0]
    # Along the slope the weight is exp(-1) but for the epsilon, and 1 across: not what it is without a depth.
    assert along.var() < light.var() / 4
    assert alone.var() < along.var()
    step = torch.where(torch.arange(32) < 16, 2.0, 3.0).expand(1, 1, 8, 32)
    lit = torch.where(torch.arange(32) < 16, 0.0, light)
    assert not atrous(lit, variance, None, step)[0][..., :16].any()


def test_background_is_like_background_only() -> None:
    light = torch.rand(1, 3, 6, 12)
    depth, normal = torch.full((1, 1, 6, 12), 2.0), torch.zeros(1, 3, 6, 12)
    depth[..., :6] = torch.inf
    normal[:, 2, :, 6:] = 1
    variance = torch.full((1, 1, 6, 12), 1e10)
    filtered, _ = atrous(light, variance, normal, depth)
    for part in (slice(0, 6), slice(6, 12)):
        torch.testing.assert_close(filtered[..., part], atrous(light[..., part], variance[..., part])[0])


def test_variance_of_moments_is_that_of_the_samples() -> None:
    samples = torch.rand(50, 3, 4, 5, dtype=torch.float64)
    moments = luminance_moments(samples).mean(0, keepdim=True)
    bright = luminance_moments(samples)[:, :1]
    torch.testing.assert_close(moments_variance(moments), bright.var(0, correction=0)[None])


def test_variance_over_a_window_is_that_of_its_pixels() -> None:
    moments = luminance_moments(torch.rand(1, 3, 9, 9, dtype=torch.float64))
    expected = moments[0, 0, 1:8, 1:8].var(correction=0)
    torch.testing.assert_close(moments_variance(moments, kernel_size=7)[0, 0, 4, 4], expected)
    # Across an edge there is no variance: each side is constant.
    light = torch.where(torch.arange(9) < 4, 0.2, 0.9).double().expand(1, 3, 9, 9)
    depth = torch.where(torch.arange(9) < 4, 1.0, 2.0).expand(1, 1, 9, 9)
    assert moments_variance(luminance_moments(light), None, depth, kernel_size=7).max() < 1e-15
    assert moments_variance(luminance_moments(light), kernel_size=7)[..., 4].min() > 0.05
