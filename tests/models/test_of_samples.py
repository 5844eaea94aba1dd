"""Common properties of methods of single samples: light without noise, tiles, layers, and their wrappers."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from toys import drawn, sampled

from mcdenoise.frame import Hints
from mcdenoise.models import create_model
from mcdenoise.models.layered import LayeredNetwork
from mcdenoise.models.sbmc import SbmcNetwork

NETWORKS: dict[str, Callable[[], LayeredNetwork | SbmcNetwork]] = {
    "layered": lambda: LayeredNetwork(4, 1, 3),
    "sbmc": lambda: SbmcNetwork(4, 2, 1, 3),
}
both = pytest.mark.parametrize("name", NETWORKS)


@both
@torch.no_grad()
def test_light_without_noise_comes_back(name: str) -> None:
    """The whole model: albedo and exposure of samples and color are undone, and alphas sum to one."""
    given = sampled(9, 8).to(torch.float32)
    assert given.albedo is not None
    light = 2 * given.albedo.clamp_min(0.04)
    samples = light[:, None].repeat(1, 3, 1, 1, 1)
    output, _ = create_model(name, width=4)(given.replace(color=light, samples=samples))
    torch.testing.assert_close(output.image, light, rtol=1e-4, atol=1e-4)


@both
@torch.no_grad()
def test_layers_of_light_and_alpha_go_where_the_samples_go(name: str) -> None:
    network, given = drawn(NETWORKS[name](), 0.4), sampled(5, 6, samples=1)
    layers = {"half": given.color / 2, "rest": given.color / 2}
    alpha = torch.ones_like(given.color[:, :1])
    output, _ = network(given.replace(layers=layers, alpha=alpha, hints=Hints(alpha=True)))
    for layer in output.layers.values():
        torch.testing.assert_close(layer, output.image / 2)
    torch.testing.assert_close(output.alpha, alpha)
