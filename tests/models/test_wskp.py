"""WSKP and its U-Net against their equations, written out in float64, and the merging of branches."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from test_cascaded import frame_of_doubles
from torch import Tensor, nn
from toys import refused

from mcdenoise.frame import Frame
from mcdenoise.models import Tiled, create_model, parts_of
from mcdenoise.models.wskp import Reparameterized, WskpNetwork

SIZE = (5, 6)


def drawn(network: nn.Module) -> Any:
    torch.manual_seed(3)
    for parameter in network.parameters():
        nn.init.normal_(parameter, std=0.15)
    return network.double()


def branches(layer: Reparameterized, x: Tensor) -> Tensor:
    total = sum(F.conv2d(x, branch.weight, padding=branch.kernel_size[0] // 2) for branch in layer.branches)
    return total + x if layer.identity else total


@pytest.mark.parametrize("identity", [True, False])
def test_the_merged_kernel_equals_the_branches(identity: bool) -> None:
    layer = drawn(Reparameterized(6, 6 if identity else 4, identity))
    x = torch.rand(2, 6, 5, 7, dtype=torch.float64)
    found, expected = layer(x), branches(layer, x)
    torch.testing.assert_close(found, expected)
    merged = nn.Conv2d(6, expected.shape[1], 5, padding=2, bias=False).double()
    merged.load_state_dict({"weight": layer.merged()})
    torch.testing.assert_close(merged(x), expected)
    weights = list(layer.parameters())
    pairs = zip(
        torch.autograd.grad(found.square().sum(), weights),
        torch.autograd.grad(expected.square().sum(), weights),
        strict=True,
    )
    for own, other in pairs:
        torch.testing.assert_close(own, other)


@pytest.mark.parametrize(("layers", "expected"), [(6, 27_300), (3, 12_600)])
def test_parameters_and_products_of_the_deployed_network(layers: int, expected: int) -> None:
    """No biases: as many products a pixel as parameters."""
    network = next(parts_of(create_model("wskp", layers=layers), Tiled)).inner
    assert isinstance(network, WskpNetwork)
    assert sum(layer.merged().numel() for layer in network.layers) == expected
    assert [layer.identity for layer in network.layers] == [False, *[True] * (layers - 2), False]


def bright_frame() -> Frame:
    """No albedo so dark that it is not divided out."""
    frame = frame_of_doubles(*SIZE)
    assert frame.albedo is not None
    return frame.replace(albedo=0.2 + 0.8 * frame.albedo)


def seen(frame: Frame) -> Tensor:
    """Return the input of the networks."""
    assert frame.albedo is not None
    assert frame.normal is not None
    assert frame.depth is not None
    hit = frame.depth.isfinite()
    typical = torch.exp(torch.log(frame.depth[hit]).mean())
    depth = torch.where(hit, frame.depth / (frame.depth + typical), 1)
    lit = (frame.color * frame.albedo) ** (1 / 2.2)
    return torch.cat([lit, frame.albedo, frame.normal * 0.5 + 0.5, depth], 1)


def filtered(image: Tensor, maps: Tensor, radii: tuple[int, ...]) -> Tensor:
    """``sum_i softmax(a)_i sum_q exp(m_i(q)) c(q) / sum_q exp(m_i(q))`` over the taps q inside, in loops."""
    number, (height, width) = len(radii), image.shape[-2:]
    rows, out = maps[0].tolist(), torch.zeros_like(image)
    for y in range(height):
        for x in range(width):
            blend = [math.exp(rows[number + i][y][x]) for i in range(number)]
            for i, radius in enumerate(radii):
                total, weights = torch.zeros(3, dtype=torch.float64), 0.0
                for row in range(max(0, y - radius), min(height, y + radius + 1)):
                    for column in range(max(0, x - radius), min(width, x + radius + 1)):
                        weight = math.exp(rows[i][row][column])
                        total += weight * image[0, :, row, column]
                        weights += weight
                out[0, :, y, x] += blend[i] / sum(blend) * total / weights
    return out


@torch.no_grad()
def test_it_is_its_equations() -> None:
    network, frame = drawn(WskpNetwork(5, 3)), bright_frame()
    x = seen(frame)
    for number, layer in enumerate(network.layers):
        x = branches(layer, x)
        x = torch.where(x > 0, x, 0.1 * x) if number < 2 else x
    torch.testing.assert_close(network(frame)[0].image, filtered(frame.color, x, (1, 2, 3, 4, 5, 6)))


@torch.no_grad()
def test_tiles_give_the_image() -> None:
    network, frame = drawn(WskpNetwork(4, 4)), frame_of_doubles(9, 100)
    frame = frame.replace(statistics=network.statistics(frame))
    torch.testing.assert_close(Tiled(network, side=32)(frame)[0].image, network(frame)[0].image)


@torch.no_grad()
def test_weights_that_steepen_the_maps_give_an_image() -> None:
    """Importances of thousands, of which the public code has an exponential that is infinite."""
    network = drawn(WskpNetwork())
    nn.init.normal_(network.layers[-1].branches[0].weight, std=300)
    frame = frame_of_doubles(12, 20).to(torch.float32)
    importance, _ = network.float().maps(frame)
    assert importance.abs().max() > 1000
    image = network(frame)[0].image
    assert image.isfinite().all()
    assert image.max() <= frame.color.max() * (1 + 1e-5)


def test_too_few_layers_are_refused() -> None:
    assert refused(lambda: create_model("wskp", layers=1)) == "layers: expected at least 2, found 1"
