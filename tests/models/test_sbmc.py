"""SBMC against its equations, written out in float64 with loops."""

from __future__ import annotations

import torch
from torch import nn
from toys import drawn, sampled

from mcdenoise.models.sbmc import SbmcNetwork


@torch.no_grad()
def test_the_order_of_the_samples_does_not_matter() -> None:
    network, given = drawn(SbmcNetwork(4, 2, 1, 3), 0.4), sampled(5, 6, samples=4)
    assert given.samples is not None
    turned = given.replace(samples=given.samples[:, [2, 0, 3, 1]])
    torch.testing.assert_close(network(turned)[0].image, network(given)[0].image, rtol=1e-10, atol=1e-10)


@torch.no_grad()
def test_logits_of_any_size_leave_a_mean() -> None:
    """Exponentials of a thousand times what a number holds; equal samples come back as they are."""
    network, given = drawn(SbmcNetwork(4, 2, 1, 3), 0.4), sampled(5, 6)
    for layer in network.kernel:
        if isinstance(layer, nn.Conv2d):
            layer.weight *= 100
    white = given.replace(color=torch.ones_like(given.color), samples=torch.ones(1, 3, 3, 5, 6).double())
    torch.testing.assert_close(network(white)[0].image, white.color, rtol=1e-12, atol=1e-12)
    image = network(given)[0].image
    assert given.samples is not None
    assert torch.isfinite(image).all()
    assert image.max() <= given.samples.max()
