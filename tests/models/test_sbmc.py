"""SBMC against its equations, written out in float64 with loops."""

from __future__ import annotations

import math

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from toys import refused, sampled

from mcdenoise.frame import Frame
from mcdenoise.models import create_model
from mcdenoise.models.sbmc import PUBLISHED, SbmcNetwork, sbmc
from mcdenoise.nn.samples import samples_input


def drawn(width: int = 4, rounds: int = 2, convolutions: int = 1, kernel_size: int = 3) -> SbmcNetwork:
    """Return the network with weights in float64, so that every part of the equations has an effect."""
    torch.manual_seed(3)
    network = SbmcNetwork(width, rounds, convolutions, kernel_size).double()
    for parameter in network.parameters():
        nn.init.normal_(parameter, std=0.4)
    return network


def splat(network: SbmcNetwork, given: Frame, samples: Tensor) -> Tensor:
    """Return the sum of all splats of every sample of every pixel, divided by the sum of their weights."""
    given = given.replace(statistics=network.statistics(given))
    embedded, context = network.embedding(samples_input(given, samples))
    height, width = given.size
    total, weights = torch.zeros(1, 3, height, width).double(), torch.zeros(1, 1, height, width).double()
    for sample, own in zip(samples.unbind(1), embedded.unbind(1), strict=True):
        x = torch.cat([own, context], 1)
        layers = [layer for layer in network.kernel if isinstance(layer, nn.Conv2d)]
        for number, layer in enumerate(layers):
            x = F.conv2d(x, layer.weight, layer.bias)
            x = torch.where(x > 0, x, 0.01 * x) if number < len(layers) - 1 else x
        side = math.isqrt(x.shape[1])
        for y in range(height):
            for column in range(width):
                for tap in range(side**2):
                    qy, qx = y + tap // side - side // 2, column + tap % side - side // 2
                    if 0 <= qy < height and 0 <= qx < width:
                        weight = torch.exp(x[0, tap, y, column])
                        total[..., qy, qx] += weight * sample[..., y, column]
                        weights[..., qy, qx] += weight
    return total / weights


@pytest.mark.parametrize("kernel_size", [1, 3, 5])
@torch.no_grad()
def test_the_splat_written_out(kernel_size: int) -> None:
    network, given = drawn(kernel_size=kernel_size), sampled(5, 6)
    assert given.samples is not None
    output, state = network(given)
    torch.testing.assert_close(output.image, splat(network, given, given.samples), rtol=1e-9, atol=1e-9)
    assert state is None


@torch.no_grad()
def test_without_samples_the_color_is_one() -> None:
    network, given = drawn(), sampled(5, 6, samples=0)
    expected = splat(network, given, given.color[:, None])
    torch.testing.assert_close(network(given)[0].image, expected, rtol=1e-9, atol=1e-9)
    one = given.replace(samples=given.color[:, None])
    torch.testing.assert_close(network(one)[0].image, expected, rtol=1e-9, atol=1e-9)


@torch.no_grad()
def test_a_history_is_one_more_sample() -> None:
    network, given = drawn(), sampled(5, 6).replace(length=torch.full((1, 1, 5, 6), 3.0).double())
    assert given.samples is not None
    given = given.replace(color=2 * given.color)
    expected = splat(network, given, torch.cat([given.samples, given.color[:, None]], 1))
    torch.testing.assert_close(network(given)[0].image, expected, rtol=1e-9, atol=1e-9)


@torch.no_grad()
def test_the_order_of_the_samples_does_not_matter() -> None:
    network, given = drawn(), sampled(5, 6, samples=4)
    assert given.samples is not None
    turned = given.replace(samples=given.samples[:, [2, 0, 3, 1]])
    torch.testing.assert_close(network(turned)[0].image, network(given)[0].image, rtol=1e-10, atol=1e-10)


@torch.no_grad()
def test_logits_of_any_size_leave_a_mean() -> None:
    """Exponentials of a thousand times what a number holds; equal samples come back as they are."""
    network, given = drawn(), sampled(5, 6)
    for layer in network.kernel:
        if isinstance(layer, nn.Conv2d):
            layer.weight *= 100
    white = given.replace(color=torch.ones_like(given.color), samples=torch.ones(1, 3, 3, 5, 6).double())
    torch.testing.assert_close(network(white)[0].image, white.color, rtol=1e-12, atol=1e-12)
    image = network(given)[0].image
    assert given.samples is not None
    assert torch.isfinite(image).all()
    assert image.max() <= given.samples.max()


def weights(width: int, rounds: int, convolutions: int, kernel_size: int) -> tuple[int, int]:
    """Numbers of parameters, and of multiply-adds a pixel with one sample, from the sizes of the layers."""
    chain = [(first, width) for first in (11, *[2 * width] * (rounds - 1))] + [(width, width)] * 2 * rounds
    kernel = [(2 * width, width), (width, width), (width, kernel_size**2)]
    unet = []
    for level, entering in enumerate((width, width, 2 * width)):
        own = width << level
        unet += [(entering, own, level)] + [(own, own, level)] * (convolutions - 1)
    for level in (1, 0):
        own = width << level
        unet += [(3 * own, own, level)] + [(own, own, level)] * (convolutions - 1)
    parameters = sum(a * b + b for a, b in (*chain, *kernel)) + rounds * sum(9 * a * b + b for a, b, _ in unet)
    macs = sum(a * b for a, b in (*chain, *kernel)) + rounds * sum(9 * a * b / 4**level for a, b, level in unet)
    return parameters, int(macs)


def test_the_published_size() -> None:
    with torch.device("meta"):
        network = next(part for part in sbmc(**PUBLISHED).modules() if isinstance(part, SbmcNetwork))  # type: ignore[attr-defined]
    assert sum(parameter.numel() for parameter in network.parameters()) == weights(128, 3, 3, 21)[0]
    assert network.kernel[-1].weight.shape[0] == 441
    assert network.needs.reach == 3 * (3 * 10 + 6 + 3) + 10


@pytest.mark.parametrize(("setting", "value"), [("width", 0), ("rounds", 0), ("convolutions", 0), ("kernel_size", 4)])
def test_settings_out_of_range_are_refused(setting: str, value: int) -> None:
    assert refused(lambda: create_model("sbmc", **{setting: value})).startswith(f"{setting}: expected ")
