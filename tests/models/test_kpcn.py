"""KPCN against its equations, in float64, with that of its filter as loops over pixels."""

from typing import Any

import torch
import torch.nn.functional as F
from oracles.filters import cross_bilateral_filter
from torch import Tensor, nn
from toys import drawn, frame_of

from mcdenoise.frame import Frame, Hints
from mcdenoise.models import create_model
from mcdenoise.models._wrapper import parts_of
from mcdenoise.models.kpcn import CHANNELS, KpcnNetwork
from mcdenoise.ops import luminance_moments, moments_variance


def parts(height: int, width: int, **changes: Any) -> Frame:
    generator = torch.Generator().manual_seed(5)
    light = {name: 3 * torch.rand(1, 3, height, width, generator=generator) for name in ("diffuse", "specular")}
    return frame_of(height, width, **light).to(torch.float64).replace(**changes)


def seen(image: Tensor, frame: Frame) -> Tensor:
    """The 27 channels."""
    albedo, normal, depth = frame.albedo, frame.normal, frame.depth
    hit = torch.isfinite(depth)
    near = torch.where(hit, depth / (depth + torch.exp(torch.log(depth[hit]).mean())), 1)
    features = torch.cat([albedo, (normal + 1) / 2, near], 1)
    bright = (image * torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64).reshape(1, 3, 1, 1)).sum(
        1, keepdim=True
    )
    values = torch.cat([bright, features], 1)
    across, down = torch.zeros_like(values), torch.zeros_like(values)
    across[..., :-1] = values[..., 1:] - values[..., :-1]
    down[..., :-1, :] = values[..., 1:, :] - values[..., :-1, :]
    variance = moments_variance(luminance_moments(image), normal, depth, kernel_size=7)
    return torch.cat([image, features, across, down, torch.log(1 + variance)], 1)


def filtered(branch: Any, image: Tensor, frame: Frame) -> Tensor:
    """Convolutions with ReLU between them, the softmax of Eq. 8, and the mean of Eq. 9 over the taps inside."""
    x = seen(image, frame)
    assert x.shape[1] == CHANNELS
    convolutions = [layer for layer in branch if isinstance(layer, nn.Conv2d)]
    for number, layer in enumerate(convolutions):
        x = F.conv2d(x if number == 0 else x.clamp_min(0), layer.weight, layer.bias, padding=2)
    return cross_bilateral_filter(image, x, border="renormalize")


@torch.no_grad()
def test_color_only_is_the_diffuse_branch() -> None:
    network, frame = drawn(KpcnNetwork(4, 3, 3), 0.1), parts(6, 7)
    alone = frame.replace(diffuse=None, specular=None)
    expected = filtered(network.diffuse, frame.color, frame)
    torch.testing.assert_close(network(alone)[0].image, expected, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(network(frame.replace(specular=None))[0].image, expected, rtol=1e-9, atol=1e-9)
    dark = frame.replace(diffuse=frame.color, specular=torch.zeros_like(frame.color))
    torch.testing.assert_close(network(dark)[0].image, expected, rtol=1e-9, atol=1e-9)


def test_color_only_teaches_the_diffuse_branch_only() -> None:
    network = drawn(KpcnNetwork(4, 3, 3), 0.1)
    network(parts(6, 7, diffuse=None, specular=None))[0].image.sum().backward()
    assert all(parameter.grad is not None for parameter in network.diffuse.parameters())
    assert all(parameter.grad is None for parameter in network.specular.parameters())


@torch.no_grad()
def test_a_network_for_color_alone_has_one_branch_and_says_so() -> None:
    torch.manual_seed(3)
    network, frame = KpcnNetwork(4, 3, 3, split=False).double(), parts(6, 7)
    assert not {"diffuse", "specular", "emission"} & network.needs.uses
    assert {name.partition(".")[0] for name, _ in network.named_parameters()} == {"diffuse"}
    expected = filtered(network.diffuse, frame.color, frame)
    for each, given, reason in (
        (network, frame, "these weights are for color alone"),
        (drawn(KpcnNetwork(4, 3, 3), 0.1), frame.replace(diffuse=None), "no diffuse and specular light"),
        (drawn(KpcnNetwork(4, 3, 3), 0.1), frame, "diffuse and specular light"),
    ):
        output, _ = each(given)
        assert output.notes[0][:3] == ("specular branch", reason, reason != "diffuse and specular light")
        if each is network:
            torch.testing.assert_close(output.image, expected, rtol=1e-9, atol=1e-9)


def test_the_shipped_weights_are_for_color_alone() -> None:
    model = create_model("kpcn", pretrained=True)
    (network,) = parts_of(model, KpcnNetwork)
    assert network.specular is None


@torch.no_grad()
def test_both_parts_have_a_history() -> None:
    """A still scene: what is filtered is the mean of two frames, of each part."""
    model, frame = create_model("kpcn", width=4, alpha_min=0.5), parts(9, 8).to(torch.float32)
    wall = {"position": torch.rand(1, 3, 9, 8), "motion": torch.zeros(1, 2, 9, 8)}
    first, second = (
        frame.replace(**wall, **{name: factor * getattr(frame, name) for name in ("color", "diffuse", "specular")})
        for factor in (1.0, 3.0)
    )
    _, state = model(first)
    output, _ = model(second, state)
    both = frame.replace(**wall, **{name: 2 * getattr(frame, name) for name in ("color", "diffuse", "specular")})
    torch.testing.assert_close(output.image, model(both)[0].image, rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_layers_are_filtered_with_the_kernels_of_their_light() -> None:
    network, frame = drawn(KpcnNetwork(4, 3, 3), 0.1), parts(6, 7)
    layers = {"matt": frame.diffuse, "shiny": frame.specular}
    hints = Hints(alpha=True)
    alpha = torch.ones_like(frame.color[:, :1])
    output, _ = network(frame.replace(layers=layers, alpha=alpha, hints=hints))
    torch.testing.assert_close(output.image, network(frame)[0].image)
    torch.testing.assert_close(output.alpha, alpha)
    # Without specular light all kernels are those of the diffuse branch.
    dark = frame.replace(specular=torch.zeros_like(frame.specular), layers={"matt": frame.diffuse})
    output, _ = network(dark)
    torch.testing.assert_close(output.layers["matt"], output.image)
