"""Common properties of the methods in the paper's comparison."""

import math

import pytest
import torch

from mcdenoise.frame import Frame
from mcdenoise.models import Accumulated, create_model
from mcdenoise.models._published import Network, displayed
from mcdenoise.models._wrapper import parts_of

WEARERS = ["bmfr", "cascaded", "kp", "kpcn", "layered", "mrkp", "nbgd", "sbmc", "wskp"]


@pytest.mark.parametrize("name", WEARERS)
def test_all_are_given_the_same_accumulation(name: str) -> None:
    (accumulated,) = parts_of(create_model(name, alpha_min=0.3), Accumulated)
    assert accumulated.alpha_min == 0.3
    # The published accumulation looks for no fireflies, mirrors or changes of light.
    assert accumulated.firefly_limit == accumulated.specular_length == accumulated.lag_threshold == math.inf
    assert accumulated.also == (("diffuse", "specular") if name == "kpcn" else ())


def test_the_ten_channels() -> None:
    image, albedo = torch.rand(2, 3, 4, 5), torch.rand(2, 3, 4, 5)
    normal, depth = torch.rand(2, 3, 4, 5) * 2 - 1, torch.full((2, 1, 4, 5), 7.0)
    depth[:, :, 0] = torch.inf
    seen = Network().input_of(Frame(image, albedo=albedo, normal=normal, depth=depth), 2 * image)
    # All surfaces are at the typical depth.
    near = torch.where(torch.isinf(depth), 1.0, 0.5)
    torch.testing.assert_close(seen, torch.cat([2 * image, albedo, (normal + 1) / 2, near], 1))


def test_displayed_values_and_their_slope_at_black_and_white() -> None:
    albedo, light = torch.full((1, 3, 1, 2), 0.25), torch.tensor([0.0, 4.0]).expand(1, 3, 1, 2).clone()
    light.requires_grad_()
    shown = displayed(Frame(light, albedo=albedo))
    torch.testing.assert_close(shown[0, 0, 0], torch.tensor([1e-6 ** (1 / 2.2), 1.0]))
    # At black the power has no finite slope; at one the slope is 1 / 2.2.
    (slope,) = torch.autograd.grad(shown.sum(), light)
    torch.testing.assert_close(slope[0, 0, 0], torch.tensor([0.0, 0.25 / 2.2]))
    torch.testing.assert_close(displayed(Frame(light.detach())), light.detach().clamp_min(1e-6) ** (1 / 2.2))


@pytest.mark.parametrize("name", WEARERS)
def test_every_shot_with_motion_has_the_published_average(name: str) -> None:
    """Packed takes have no positions: their networks must not be trained on frames that stand alone."""
    size = (1, 3, 16, 16)
    surface = {"albedo": torch.ones(size), "normal": torch.ones(size), "depth": torch.ones(1, 1, 16, 16)}
    if name == "bmfr":
        surface["position"] = torch.ones(size)
    model, state = create_model(name).eval(), None
    colors = torch.rand(7, *size)
    expected = colors[0]
    for number, color in enumerate(colors):
        output, state = model(Frame(color, motion=torch.zeros(1, 2, 16, 16), **surface), state)
        expected = torch.lerp(expected, color, max(1 / (number + 1), 0.2))
        torch.testing.assert_close(output.stages["accumulated"], expected, rtol=1e-5, atol=1e-6)
