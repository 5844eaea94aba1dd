"""Fireflies are clamped before a method sees them."""

from __future__ import annotations

import pytest
import torch
from toys import Same, frame_of

from mcdenoise import Frame
from mcdenoise.models import Clamped, create_model
from mcdenoise.models.clamped import without_fireflies
from mcdenoise.train.front import split


def test_a_firefly_has_thirty_times_the_light_around_it_and_its_own_hue() -> None:
    albedo = torch.full((1, 3, 40, 60), 0.5)
    albedo[..., 30:] = 0.2
    light = torch.ones(1, 3, 40, 60)
    light[..., :9, :] += torch.rand(1, 3, 9, 60, generator=torch.Generator().manual_seed(0))
    frame = Frame(albedo * light * torch.tensor([1.0, 2.0, 3.0]).reshape(1, 3, 1, 1), albedo=albedo)
    color = frame.color.clone()
    color[..., 20, 29] *= 1e4
    output, _ = Clamped(Same())(frame.replace(color=color))
    torch.testing.assert_close(output.image[..., 20, 29], 30 * frame.color[..., 20, 29])
    output.image[..., 20, 29] = frame.color[..., 20, 29]
    assert torch.equal(output.image, frame.color)


def test_the_more_light_fireflies_have_the_less_they_are_clamped() -> None:
    highest = {}
    # One firefly in every fourth block of 32x32 pixels, in every block, and 16 in every block.
    for apart in (64, 32, 8):
        color = torch.ones(1, 3, 192, 256)
        color[..., 4::apart, 4::apart] = 100
        # A frame without noise has no fireflies.
        color[..., 160:, :] = 0.5 + torch.rand(1, 3, 32, 256, generator=torch.Generator().manual_seed(0))
        clamped = without_fireflies(Frame(color)).color
        highest[apart] = float(clamped.max())
        assert torch.equal(clamped[color == 1], color[color == 1])
    assert highest[64] == pytest.approx(30)
    # The limit rises fourfold where they have 5 to 15 % of the light.
    light = 85 / (1023 + 100)
    assert highest[32] == pytest.approx(30 * 4 ** ((light - 0.05) / 0.1), rel=1e-4)
    assert highest[8] == 100


@pytest.mark.parametrize("value", [0.0, 1e-30, 1e16])
def test_even_radiance_is_kept_bit_by_bit(value: float) -> None:
    frame = frame_of(24, 40).replace(color=torch.full((1, 3, 24, 40), value))
    assert torch.equal(without_fireflies(frame).color, frame.color)


def test_fireflies_do_not_brighten_the_surface_around_them() -> None:
    generator = torch.Generator().manual_seed(0)
    color = 0.5 + 0.1 * torch.rand(1, 3, 96, 128, generator=generator)
    # Fewer than one in half of the blocks of 32x32 pixels, with much light.
    bright = torch.rand(1, 1, 96, 128, generator=generator) < 1 / 3000
    assert bright.any()
    features = {"albedo": torch.full_like(color, 0.5), "normal": torch.eye(3)[2].reshape(1, 3, 1, 1).expand_as(color)}
    frame, clean = (Frame(each, **features) for each in (torch.where(bright, 1000 * color, color), color))
    model, other = (create_model("oidn_tuned", pretrained=True, clamp=on).eval() for on in (True, False))
    with torch.no_grad():
        expected, clamped = (model(each)[0].image.mean() for each in (clean, frame))
        without = other(frame)[0].image.mean()
    assert expected == pytest.approx(0.55, rel=0.05)
    assert abs(clamped - expected) < abs(without - expected) / 4


def test_training_sees_all_light() -> None:
    inner = Same()
    assert split(Clamped(inner))[1] is inner
