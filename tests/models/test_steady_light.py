"""Steady light is no firefly: a star in every frame passes, a flash in one does not."""

import pytest
import torch
from torch import Tensor
from toys import Same

from mcdenoise import Denoiser, Frame
from mcdenoise.models import Accumulated, Model

STAR, FLASH = (20, 31), (11, 50)


def sky(number: int, *, drift: int = 0, **more: Tensor) -> Frame:
    """A noisy sky of 0.001, a star of 1 in every frame, and a flash of 1000 in the third."""
    generator = torch.Generator().manual_seed(number)
    color = 1e-3 * (0.5 + torch.rand(1, 1, 40, 64, generator=generator)).expand(-1, 3, -1, -1).clone()
    color[..., STAR[0], STAR[1] + drift * number] = 1
    if number == 2:
        color[(..., *FLASH)] = 1e3
    return Frame(color, **more)


def images(model: Model, frames: list[Frame]) -> list[Tensor]:
    denoiser = Denoiser(model)
    return [denoiser(frame) for frame in frames]


def dark(color: Tensor) -> Tensor:
    """Takes every bright pixel for noise, as a network does."""
    return color.clamp_max(2e-3)


@pytest.mark.parametrize("moves", [False, True])
def test_a_star_passes_and_a_flash_does_not(moves: bool) -> None:
    motion = torch.zeros(1, 2, 40, 64)
    motion[:, 0] = -1 if moves else 0
    frames = [sky(number, drift=int(moves), motion=motion) for number in range(8)]
    found = images(Accumulated(dark), frames)
    assert found[0][..., STAR[0], STAR[1]].mean() < 0.04
    assert found[7][..., STAR[0], STAR[1] + 7 * moves].mean() > 0.5
    assert found[2][(..., *FLASH)].mean() < 0.1
    assert found[3][..., FLASH[0], FLASH[1]].mean() < 0.02


def test_without_motion_the_same_place_tells() -> None:
    found = images(Accumulated(Same()), [sky(number) for number in range(5)])
    assert found[0][(..., *STAR)].mean() < 0.04
    assert found[4][(..., *STAR)].mean() == pytest.approx(1, rel=1e-6)
    assert found[2][(..., *FLASH)].mean() < 0.1


def test_a_star_may_move_by_a_third_of_a_pixel() -> None:
    motion = torch.zeros(1, 2, 40, 64)
    motion[:, 0] = -1 / 3
    denoiser = Denoiser(Accumulated(dark))
    for number in range(12):
        frame = sky(0, motion=motion)
        image = frame.color.clone()
        image[(..., *STAR)] = 1e-3
        place = (STAR[0], STAR[1] + (number + 1) // 3)
        image[(..., *place)] = 1
        found = denoiser(frame.replace(color=image))
    assert found[(..., *place)].mean() > 0.95


def test_layers_of_a_star_add_up_to_it() -> None:
    denoiser = Denoiser(Accumulated(dark))
    for number in range(6):
        frame = sky(number)
        output = denoiser.output(frame.replace(layers={"a": frame.color / 4, "b": frame.color * 0.75}))
    assert output.image[(..., *STAR)].mean() > 0.95
    torch.testing.assert_close(output.layers["a"] + output.layers["b"], output.image)
    torch.testing.assert_close(3 * output.layers["a"][(..., *STAR)], output.layers["b"][(..., *STAR)])
