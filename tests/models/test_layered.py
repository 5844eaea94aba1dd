"""Layer embeddings against their equations, written out in float64 with loops."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from toys import refused, sampled

from mcdenoise.frame import Frame
from mcdenoise.models import create_model
from mcdenoise.models.layered import LayeredNetwork
from mcdenoise.nn.samples import samples_input


def drawn(width: int = 4, convolutions: int = 1, kernel_size: int = 3) -> LayeredNetwork:
    """Return the network with weights in float64, so that every part of the equations has an effect."""
    torch.manual_seed(3)
    network = LayeredNetwork(width, convolutions, kernel_size).double()
    for parameter in network.parameters():
        nn.init.normal_(parameter, std=0.4)
    return network


def chained(x: Tensor, layers: nn.Sequential) -> Tensor:
    """1x1 convolutions with leaky ReLU between them."""
    convolutions = [layer for layer in layers if isinstance(layer, nn.Conv2d)]
    for number, layer in enumerate(convolutions):
        x = F.conv2d(x if number == 0 else torch.where(x > 0, x, 0.01 * x), layer.weight, layer.bias)
    return x


def gathered(image: Tensor, logits: Tensor) -> Tensor:
    """Softmax over the taps inside the image."""
    (height, width), side = image.shape[-2:], math.isqrt(logits.shape[1])
    result = torch.zeros_like(image)
    for y in range(height):
        for x in range(width):
            weights = 0.0
            for tap in range(side**2):
                qy, qx = y + tap // side - side // 2, x + tap % side - side // 2
                if 0 <= qy < height and 0 <= qx < width:
                    weight = torch.exp(logits[0, tap, y, x])
                    result[..., y, x] += weight * image[..., qy, qx]
                    weights += weight
            result[..., y, x] /= weights
    return result


def composited(network: LayeredNetwork, given: Frame, samples: Tensor) -> Tensor:
    """Partition, filters and alpha of two layers."""
    given = given.replace(statistics=network.statistics(given))
    embedded, context = network.embedding(samples_input(given, samples))
    count = samples.shape[1]
    held = [torch.zeros(1, 4, *given.size).double() for _ in range(2)]
    embeddings = [torch.zeros_like(context) for _ in range(2)]
    for s in range(count):
        logits = chained(torch.cat([embedded[:, s], context], 1), network.partition)
        weights = torch.exp(logits) / torch.exp(logits).sum(1, keepdim=True)
        for number in range(2):
            # At least a thousandth of a sample is in each of the two.
            weight = 0.001 + 0.998 * weights[:, number : number + 1]
            held[number] += weight * torch.cat([samples[:, s], torch.ones_like(weight)], 1) / count
            embeddings[number] += weight * embedded[:, s] / count
    predicted = chained(network.unet(torch.cat([*embeddings, context], 1)), network.head)
    taps = (predicted.shape[1] - 1) // 2
    front, back = (gathered(held[i], predicted[:, i * taps : (i + 1) * taps]) for i in range(2))
    alpha = 1 / (1 + torch.exp(-predicted[:, -1:]))
    return alpha * front[:, :3] / front[:, 3:] + (1 - alpha) * back[:, :3] / back[:, 3:]


@pytest.mark.parametrize("kernel_size", [1, 5])
@torch.no_grad()
def test_the_layers_written_out(kernel_size: int) -> None:
    network, given = drawn(kernel_size=kernel_size), sampled(5, 6)
    assert given.samples is not None
    output, state = network(given)
    torch.testing.assert_close(output.image, composited(network, given, given.samples), rtol=1e-9, atol=1e-9)
    assert state is None


@torch.no_grad()
def test_without_samples_the_color_is_one() -> None:
    network, given = drawn(), sampled(5, 6, samples=0)
    expected = composited(network, given, given.color[:, None])
    torch.testing.assert_close(network(given)[0].image, expected, rtol=1e-9, atol=1e-9)


@torch.no_grad()
def test_a_history_is_one_more_sample() -> None:
    network, given = drawn(), sampled(5, 6).replace(length=torch.full((1, 1, 5, 6), 3.0).double())
    assert given.samples is not None
    given = given.replace(color=2 * given.color)
    expected = composited(network, given, torch.cat([given.samples, given.color[:, None]], 1))
    torch.testing.assert_close(network(given)[0].image, expected, rtol=1e-9, atol=1e-9)


@torch.no_grad()
def test_a_firefly_in_the_layer_behind_is_not_seen() -> None:
    """Where bright samples are behind and the front is opaque, the image is as without them, up to the least weight."""
    network, given = drawn(), sampled(5, 6)
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


@pytest.mark.parametrize(("setting", "value"), [("width", 0), ("convolutions", 0), ("kernel_size", 4)])
def test_settings_out_of_range_are_refused(setting: str, value: int) -> None:
    assert refused(lambda: create_model("layered", **{setting: value})).startswith(f"{setting}: expected ")
