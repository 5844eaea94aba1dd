"""WSKP and its U-Net against their equations, written out in float64, and the merging of branches."""

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from toys import drawn, frame_of

from mcdenoise.models import Tiled, create_model
from mcdenoise.models._wrapper import parts_of
from mcdenoise.models.wskp import Reparameterized, WskpNetwork


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
    assert sum(layer.merged().numel() for layer in network.layers) == expected
    assert [layer.identity for layer in network.layers] == [False, *[True] * (layers - 2), False]


@torch.no_grad()
def test_weights_that_steepen_the_maps_give_an_image() -> None:
    """Importances of thousands, of which the public code has an exponential that is infinite."""
    network = drawn(WskpNetwork())
    nn.init.normal_(network.layers[-1].branches[0].weight, std=300)
    frame = frame_of(12, 20)
    importance, _ = network.float().maps(frame)
    assert importance.abs().max() > 1000
    image = network(frame)[0].image
    assert image.isfinite().all()
    assert image.max() <= frame.color.max() * (1 + 1e-5)
