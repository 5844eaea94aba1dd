"""Layer embeddings against their equations, written out in float64 with loops."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from toys import drawn, sampled

from mcdenoise.models.layered import LayeredNetwork


@torch.no_grad()
def test_a_firefly_in_the_layer_behind_is_not_seen() -> None:
    """Where bright samples are behind and the front is opaque, the image is as without them, up to the least weight."""
    network, given = drawn(LayeredNetwork(4, 1, 3), 0.4), sampled(5, 6)
    assert given.samples is not None
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
