"""A panorama has no border: what it shows does not depend on the column at which it begins."""

import numpy as np
import pytest
import torch
from torch import Tensor

import mcdenoise
from mcdenoise import Denoiser, Frame


def panorama(turn: int = 0, *, width: int = 160, number: int = 0) -> Frame:
    generator = torch.Generator().manual_seed(number)
    angle = torch.arange(width) / width * 2 * torch.pi
    light = (1.2 + torch.sin(angle)).expand(1, 3, 40, -1)
    color = light * (0.5 + torch.rand(1, 3, 40, width, generator=generator))
    motion = torch.zeros(1, 2, 40, width)
    motion[:, 0] = -3
    frame = Frame(color, albedo=0.5 * torch.ones_like(color), alpha=torch.ones_like(color[:, :1]), motion=motion)
    return frame.map(lambda image: image.roll(turn + 3 * number, -1))


@pytest.mark.parametrize("model", ["joint_bilateral", "accumulated"])
def test_the_first_column_may_be_any(model: str) -> None:
    here, there = Denoiser(model, wrap=True, alpha=True), Denoiser(model, wrap=True, alpha=True)
    for number in range(3):
        image, turned = here.output(panorama(number=number)), there.output(panorama(80, number=number))
        torch.testing.assert_close(turned.image, image.image.roll(80, -1), rtol=1e-3, atol=1e-4)
        assert image.alpha.shape == (1, 1, 40, 160)
        assert all(stage.shape[-1] == 160 for stage in image.stages.values())
    bare = Denoiser(model), Denoiser(model)
    for number in range(2):
        plain = [denoiser(panorama(turn, number=number)) for denoiser, turn in zip(bare, (0, 80), strict=True)]
    assert (plain[1] - plain[0].roll(80, -1)).abs().max() > 0.01


@pytest.mark.parametrize("width", [1, 5, 63, 100])
def test_any_width(width: int) -> None:
    def same(color: Tensor) -> Tensor:
        return color

    frame = panorama(width=width)
    assert torch.equal(Denoiser(same, wrap=True)(frame), frame.color)


def test_a_still_of_arrays() -> None:
    color = panorama().color[0].permute(1, 2, 0).numpy()
    image = mcdenoise.denoise(color, wrap=True, model="joint_bilateral")
    turned = mcdenoise.denoise(np.roll(color, 80, 1), wrap=True, model="joint_bilateral")
    # The exposure of the guide counts the columns near the border twice, which are others here and there.
    np.testing.assert_allclose(turned, np.roll(image, 80, 1), rtol=3e-3)
