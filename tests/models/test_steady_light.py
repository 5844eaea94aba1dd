"""Steady light is no firefly: a star in every frame passes, a flash in one does not."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn
from toys import Same

from mcdenoise import Denoiser, Frame
from mcdenoise.models import Accumulated, Clamped, Model, Needs, Output, State, Wrapper

STAR, FLASH = (20, 31), (11, 50)


def sky(number: int, *, drift: int = 0, **more: Tensor) -> Frame:
    """A noisy sky of 0.001, a star of 1 in every frame, and a flash of 1000 in the third."""
    generator = torch.Generator().manual_seed(number)
    color = 1e-3 * (0.5 + torch.rand(1, 1, 40, 64, generator=generator)).expand(-1, 3, -1, -1).clone()
    color[..., STAR[0], STAR[1] + drift * number] = 1
    if number == 2:
        color[(..., *FLASH)] = 1e3
    return Frame(color, **more)


def images(model: Model, frames: list[Frame]) -> tuple[list[Tensor], Denoiser]:
    denoiser = Denoiser(model)
    return [denoiser(frame) for frame in frames], denoiser


class Dark(nn.Module):
    """Takes every bright pixel for noise, as a network does."""

    needs = Needs(trainable=False)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        return Output(frame.color.clamp_max(2e-3)), None


WRAPPERS = pytest.mark.parametrize("wrapper", [Clamped, Accumulated])


@pytest.mark.parametrize("moves", [False, True])
@WRAPPERS
def test_a_star_passes_and_a_flash_does_not(wrapper: type[Wrapper], moves: bool) -> None:
    motion = torch.zeros(1, 2, 40, 64)
    motion[:, 0] = -1 if moves else 0
    frames = [sky(number, drift=int(moves), motion=motion) for number in range(8)]
    found, denoiser = images(wrapper(Dark()), frames)
    assert found[0][..., STAR[0], STAR[1]].mean() < 0.04
    assert found[7][..., STAR[0], STAR[1] + 7 * moves].mean() > 0.5
    assert found[2][(..., *FLASH)].mean() < 0.1
    assert found[3][..., FLASH[0], FLASH[1]].mean() < 0.02
    assert denoiser.report.fireflies == pytest.approx(0, abs=1e-3)


@WRAPPERS
def test_without_motion_the_same_place_tells(wrapper: type[Wrapper]) -> None:
    found, _ = images(wrapper(Same()), [sky(number) for number in range(5)])
    assert found[0][(..., *STAR)].mean() < 0.04
    assert found[4][(..., *STAR)].mean() == pytest.approx(1, rel=1e-6)
    assert found[2][(..., *FLASH)].mean() < 0.1


def test_the_report_tells_how_much_light_fireflies_have() -> None:
    _, denoiser = images(Clamped(Same()), [sky(0)])
    denoiser.reset()
    denoiser(sky(2))
    # A thousand of a light of a thousand and about four.
    assert denoiser.report.fireflies > 0.99
    assert "fireflies" in str(denoiser.report)


@WRAPPERS
def test_a_star_may_move_by_a_third_of_a_pixel(wrapper: type[Wrapper]) -> None:
    motion = torch.zeros(1, 2, 40, 64)
    motion[:, 0] = -1 / 3
    denoiser = Denoiser(wrapper(Dark()))
    for number in range(12):
        frame = sky(0, motion=motion)
        image = frame.color.clone()
        image[(..., *STAR)] = 1e-3
        place = (STAR[0], STAR[1] + (number + 1) // 3)
        image[(..., *place)] = 1
        found = denoiser(frame.replace(color=image))
    assert found[(..., *place)].mean() > 0.95


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("apart", [40, 8])
def test_stars_of_a_clean_still_pass(noise: float, apart: int) -> None:
    color = torch.linspace(1, 1.2, 64).repeat(1, 3, 40, 1)
    color = color * (1 + noise * torch.randn(1, 1, 40, 64, generator=torch.Generator().manual_seed(0)))
    color[..., STAR[0] % apart :: apart, STAR[1] % apart :: apart] = 1e3
    denoiser = Denoiser(Clamped(Same()))
    assert torch.equal(denoiser(Frame(color)), color)
    assert denoiser.report.fireflies == 0


def test_a_firefly_of_a_noisy_still_does_not() -> None:
    color = 0.8 + 0.4 * torch.rand(1, 1, 40, 64, generator=torch.Generator().manual_seed(0)).repeat(1, 3, 1, 1)
    color[(..., *STAR)] = 1e3
    denoiser = Denoiser(Clamped(Same()))
    image = denoiser(Frame(color))
    assert image[(..., *STAR)].max() < 35
    assert denoiser.report.fireflies == pytest.approx(1 - float(image.mean() / color.mean()), abs=1e-4)


def test_layers_of_a_star_add_up_to_it() -> None:
    denoiser = Denoiser(Accumulated(Dark()))
    for number in range(6):
        frame = sky(number)
        output = denoiser.output(frame.replace(layers={"a": frame.color / 4, "b": frame.color * 0.75}))
    assert output.image[(..., *STAR)].mean() > 0.95
    torch.testing.assert_close(output.layers["a"] + output.layers["b"], output.image)
    torch.testing.assert_close(3 * output.layers["a"][(..., *STAR)], output.layers["b"][(..., *STAR)])
