"""Methods of single samples: light without noise, layers, the order of samples, and logits of any size."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from toys import drawn, sampled

from mcdenoise.frame import Hints
from mcdenoise.models import create_model
from mcdenoise.models.layered import LayeredNetwork
from mcdenoise.models.sbmc import SbmcNetwork

NETWORKS: dict[str, Callable[[], Any]] = {
    "layered": lambda: LayeredNetwork(4, 1, 3),
    "sbmc": lambda: SbmcNetwork(4, 2, 1, 3),
}
both = pytest.mark.parametrize("name", NETWORKS)


@both
@torch.no_grad()
def test_light_without_noise_comes_back(name: str) -> None:
    """The whole model: albedo and exposure of samples and color are undone, and alphas sum to one."""
    given = sampled(9, 8).to(torch.float32)
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


@both
@torch.no_grad()
def test_the_order_of_the_samples_does_not_matter(name: str) -> None:
    network, given = drawn(NETWORKS[name](), 0.4), sampled(5, 6, samples=4)
    turned = given.replace(samples=given.samples[:, [2, 0, 3, 1]])
    torch.testing.assert_close(network(turned)[0].image, network(given)[0].image, rtol=1e-10, atol=1e-10)


@torch.no_grad()
def test_logits_of_any_size_leave_a_mean() -> None:
    """Exponentials of a thousand times what a number holds; equal samples come back as they are."""
    network, given = drawn(NETWORKS["sbmc"](), 0.4), sampled(5, 6)
    for layer in network.kernel:
        if isinstance(layer, nn.Conv2d):
            layer.weight *= 100
    white = given.replace(color=torch.ones_like(given.color), samples=torch.ones(1, 3, 3, 5, 6).double())
    torch.testing.assert_close(network(white)[0].image, white.color, rtol=1e-12, atol=1e-12)
    image = network(given)[0].image
    assert torch.isfinite(image).all()
    assert image.max() <= given.samples.max()


@torch.no_grad()
def test_a_firefly_in_the_layer_behind_is_not_seen() -> None:
    """Where bright samples are behind and the front is opaque, the image is as without them, up to the least weight."""
    network, given = drawn(NETWORKS["layered"](), 0.4), sampled(5, 6)
    samples = given.samples.clone()
    samples[:, 0, :, 2, 3] = 1e3

    class ByBrightness(nn.Module):
        """Decide the layer by brightness: samples darker than 100 are in front, with logits that leave no doubt."""

        def forward(self, x: Tensor) -> Tensor:
            bright = samples.flatten(0, 1).amax(1, keepdim=True) > 100
            return torch.where(torch.cat([bright, ~bright], 1), -1e3, 1e3).double()

    network.partition = ByBrightness()  # type: ignore[assignment]
    nn.init.zeros_(network.head[-1].weight)  # type: ignore[arg-type]
    nn.init.constant_(network.head[-1].bias, 50.0)  # type: ignore[arg-type]
    image = network(given.replace(samples=samples))[0].image
    # Boxes of at least four pixels with three samples each: a thousandth of 1e3 in no less than eleven.
    assert image.max() <= given.samples.max() + 1e3 * 0.001 / (11 * 0.999)
    # The plain mean of the window has more than 1e3 / 27.
    assert samples.mean(1)[..., 1:4, 2:5].mean() > 1e3 / 27
