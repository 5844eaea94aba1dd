"""The neural bilateral grid against its equations, written out in float64, and its published numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from oracles import resolutions
from test_cascaded import drawn, features, frame_of_doubles
from torch import Tensor
from toys import refused, small, whole_frame

from mcdenoise.frame import Frame
from mcdenoise.models import Tiled, create_model, parts_of
from mcdenoise.models.nbgd import NeuralBilateralGrid
from mcdenoise.nn import auto_exposure

SIZE = (6, 7)


def network_of(model: Any) -> NeuralBilateralGrid:
    return next(part for part in model.modules() if isinstance(part, NeuralBilateralGrid))


def predicted(network: NeuralBilateralGrid, frame: Frame, light: Tensor) -> Tensor:
    """Channel by channel: what follows a concatenation is applied to all of it."""
    albedo, normal, depth = features(frame)
    x = torch.cat([light.clamp_min(1e-6) ** (1 / 2.2), albedo, normal, depth], 1)

    def leaky(x: Tensor) -> Tensor:
        return torch.where(x > 0, x, 0.2 * x)

    x = leaky(F.conv2d(x, network.first.weight, network.first.bias, padding=2))
    for layer in network.dense:
        x = leaky(torch.cat([x, F.conv2d(x, layer.weight, layer.bias, padding=2)], 1))
    return 1 / (1 + torch.exp(-F.conv2d(x, network.last.weight, network.last.bias, padding=2)))


def of_grid(image: Tensor, guide: Tensor, cell: int, bins: int) -> Tensor:
    grid, filled = resolutions.grid_splat(image, guide, cell=cell, bins=bins)
    return resolutions.grid_slice(grid, filled, guide, cell=cell)


def combined(predicted: Tensor, image: Tensor) -> Tensor:
    *guides, first, second = predicted.split(1, 1)
    grids = [of_grid(image, guide, s, 256 // s) for guide, s in zip(guides, (4, 8, 16), strict=True)]
    return first * grids[0] + second * grids[1] + (1 - first - second) * grids[2]


@pytest.mark.parametrize("layers", [2, 3, 7])
@torch.no_grad()
def test_the_whole_method_written_out(layers: int) -> None:
    """A first frame: demodulation, exposure, the network, three grids, and what is below zero is cut off."""
    model = create_model("nbgd", layers=layers)
    drawn(model)
    frame = frame_of_doubles(*SIZE)
    assert frame.albedo is not None
    divisor = frame.albedo.clamp_min(0.04)
    light = frame.color / divisor
    light = light * auto_exposure(light)
    expected = combined(predicted(network_of(model), frame, light * divisor), light)
    assert (expected < 0).any() or layers != 7
    exposed = expected.clamp_min(0) / auto_exposure(frame.color / divisor)
    # In training there is no mirror image around the frame.
    output, _ = model.train()(frame)
    torch.testing.assert_close(output.image, exposed * divisor, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize(("layers", "parameters"), [(2, 7_525), (7, 29_425)])
def test_the_number_of_parameters_is_that_of_the_public_code(layers: int, parameters: int) -> None:
    network = network_of(create_model("nbgd", layers=layers))
    assert sum(parameter.numel() for parameter in network.parameters()) == parameters
    # Each weight is multiplied once a pixel, and each layer has a bias a channel.
    biases = 20 + 5 * (layers - 2) + 5
    assert sum(layer.weight.numel() for layer in network.modules() if isinstance(layer, torch.nn.Conv2d)) == (
        parameters - biases
    )


def test_less_than_two_layers_are_refused() -> None:
    assert refused(lambda: create_model("nbgd", layers=1)) == "layers: expected at least 2, found 1"


@torch.no_grad()
def test_a_constant_light_stays_what_it_is() -> None:
    """The weights of the grids sum to one, whatever the network says."""
    network, frame = drawn(NeuralBilateralGrid()), frame_of_doubles(21, 35)
    frame = frame.replace(color=torch.full_like(frame.color, 0.7))
    torch.testing.assert_close(network(frame)[0].image, frame.color, rtol=1e-12, atol=0)


@torch.no_grad()
def test_tiles_have_the_pixels_of_the_whole() -> None:
    """A tile sees the cells of its own pixels, which begin where those of the whole image do."""
    model = small("nbgd")
    tiled = next(parts_of(model, Tiled))
    frame = whole_frame(model, 100, 130)
    whole, _ = model(frame)
    tiled.side = 32
    torch.testing.assert_close(model(frame)[0].image, whole.image, rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_layers_are_filtered_with_it_and_none_is_negative() -> None:
    model = small("nbgd")
    frame = whole_frame(model, 20, 24)
    parts = {"diffuse": 0.25 * frame.color, "glossy": 0.75 * frame.color}
    alpha = torch.full_like(frame.color[:, :1], 0.6)
    output, _ = model(frame.replace(layers=parts, alpha=alpha, hints=frame.hints._replace(alpha=True)))
    assert output.alpha is not None
    torch.testing.assert_close(output.alpha, alpha)
    torch.testing.assert_close(output.layers["glossy"], 3 * output.layers["diffuse"], rtol=1e-5, atol=1e-7)
    assert all((layer >= 0).all() for layer in output.layers.values())


def test_derivatives_of_more_than_100_in_a_guide_do_not_count_in_training() -> None:
    """A loss of so many times the image has nothing but such derivatives, but for those in the weights."""
    network = NeuralBilateralGrid()
    frame = whole_frame(network, 24, 24)
    for training in (False, True):
        network.train(training)
        network.zero_grad()
        (1e12 * network(frame)[0].image).sum().backward()
        guides = network.last.weight.grad[:3]
        assert bool((guides.abs() > 1e3).any()) is not training
        assert torch.isfinite(network.last.weight.grad).all()


def test_it_learns_by_the_loss_of_its_authors(small_sequence: Path, tmp_path: Path) -> None:
    for package in ("lightning_fabric", "tensorboard"):
        pytest.importorskip(package, reason="training needs the packages of mcdenoise[train]")
    from mcdenoise.train import TrainConfig, train

    reports: list[Any] = []
    config = TrainConfig(
        model="nbgd",
        crop=16,
        frames=2,
        batch=1,
        steps=2,
        validation_frames=1,
        temporal_weight=0.0,
        loss="l1_display",
    )
    weights = train(config, [small_sequence], tmp_path / "run", checkpoint_every=1, report=reports.append)
    assert [report.step for report in reports] == [1, 2]
    assert sum(part.numel() for part in create_model("nbgd", weights=weights).parameters()) == 29_425
