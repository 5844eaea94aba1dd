"""Errors along the motion, and the flicker of static shots."""

import math

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from mcdenoise.metrics import (
    Flicker,
    UncomputableError,
    displayed,
    temporal_rmse_srgb,
    warped_rmse_srgb,
    warping_error_srgb,
)
from mcdenoise.ops import Surface


def clips(*, frames: int = 2) -> tuple[Tensor, Tensor]:
    torch.manual_seed(0)
    return torch.rand(2, frames, 3, 5, 6, dtype=torch.float64), torch.rand(2, frames, 3, 5, 6, dtype=torch.float64)


def moving(pattern: Tensor, by: int) -> Tensor:
    """``(1, 2, 3, H, W)``: a pattern, and the pattern moved to the right."""
    return torch.stack([pattern, pattern.roll(by, -1)], 1)


def motion(by: float, height: int, width: int) -> Tensor:
    return torch.tensor([-by, 0.0], dtype=torch.float64).reshape(1, 2, 1, 1).expand(1, 2, height, width)


def test_an_error_that_moves_with_its_surface_does_not_count() -> None:
    torch.manual_seed(0)
    reference, error = torch.rand(1, 3, 4, 9, dtype=torch.float64) / 2, torch.rand(1, 3, 4, 9, dtype=torch.float64) / 2
    clip, truth = moving(reference + error, 2), moving(reference, 2)
    along = motion(2, 4, 9)
    assert warping_error_srgb(clip, along).item() == pytest.approx(0, abs=1e-20)
    assert warped_rmse_srgb(clip, truth, along).item() == pytest.approx(0, abs=1e-10)
    assert temporal_rmse_srgb(clip, truth).item() > 0.1


def test_true_changes_are_no_error() -> None:
    """A surface that gets brighter: Lai's error of the truth is not 0, the error against the reference is."""
    truth = moving(torch.full((1, 3, 4, 9), 0.001, dtype=torch.float64), 1)
    truth[:, 1] *= 2
    along = motion(1, 4, 9)
    assert warping_error_srgb(truth, along).item() == pytest.approx(3 * 0.01292**2, rel=1e-4)
    assert warped_rmse_srgb(truth, truth, along).item() == 0
    # An image that stays dark is wrong by the whole change.
    dark = truth[:, :1].expand_as(truth)
    assert warped_rmse_srgb(dark, truth, along).item() == pytest.approx(0.01292, rel=1e-4)


def test_pixels_without_a_history_do_not_count() -> None:
    """The last of four columns comes from half outside the image, and the first shows another surface."""
    clip = torch.zeros(1, 2, 3, 1, 4, dtype=torch.float64)
    clip[:, 1, :, :, 0] = 1.0
    clip[:, 1, :, :, 3] = 0.001
    along = torch.zeros(1, 2, 1, 4, dtype=torch.float64)
    along[:, 0, :, 3] = 0.5
    depth = torch.ones(1, 1, 1, 4, dtype=torch.float64)
    near = depth.clone()
    near[..., 0] = 0.1
    surfaces = Surface(depth=near), Surface(depth=depth)
    # Weights 0, 1, 1 and 1/2; only the last differs.
    expected = 0.5 * 3 * 0.01292**2 / 2.5
    assert warping_error_srgb(clip, along, *surfaces).item() == pytest.approx(expected, rel=1e-4)
    assert warping_error_srgb(clip, along).item() > 0.5
    found = warped_rmse_srgb(clip, torch.zeros_like(clip), along, *surfaces)
    assert found.item() == pytest.approx(math.sqrt(expected / 3), rel=1e-4)


def test_without_any_history_there_is_no_warped_error() -> None:
    clip = torch.rand(1, 2, 3, 4, 5)
    away = torch.full((1, 2, 4, 5), torch.inf)
    for call in (lambda: warping_error_srgb(clip, away), lambda: warped_rmse_srgb(clip, clip, away)):
        with pytest.raises(UncomputableError, match="history"):
            call()


def test_warped_errors_have_a_gradient() -> None:
    clip, reference = clips()
    along = torch.full((2, 2, 5, 6), 0.3, dtype=torch.float64)
    clip = (clip * 0.8 + 0.1).requires_grad_()
    assert gradcheck(lambda x: warped_rmse_srgb(x, reference, along), (clip,), fast_mode=True)
    assert gradcheck(lambda x: warping_error_srgb(x, along), (clip,), fast_mode=True)


def flicker(clip: Tensor, reference: Tensor) -> Tensor:
    found = Flicker()
    for image, expected in zip(clip.unbind(-4), reference.unbind(-4), strict=True):
        found.add(image, expected)
    return found.value()


def test_flicker_written_out() -> None:
    # 0.001, 0.002, 0.003 show as 12.92 times as much, with a standard deviation of sqrt(2/3) of a step.
    clip = torch.tensor([0.001, 0.002, 0.003]).reshape(3, 1, 1, 1).expand(3, 3, 2, 2)
    still = torch.full_like(clip, 0.5)
    deviation = 0.01292 * math.sqrt(2 / 3)
    assert flicker(clip, still).item() == pytest.approx(deviation, rel=1e-4)
    # A result that does not follow true changes flickers less than it should; a constant error does not flicker.
    assert flicker(still, clip).item() == pytest.approx(-deviation, rel=1e-4)
    assert flicker(clip + 0.0001, clip).item() == pytest.approx(0, abs=1e-7)


def test_flicker_is_the_standard_deviation_of_each_pixel() -> None:
    clip, reference = (x.float() for x in clips(frames=9))
    shown, expected = (displayed(x).double().std(1, correction=0).mean((-3, -2, -1)) for x in (clip, reference))
    # Measured: 3e-8.
    torch.testing.assert_close(flicker(clip, reference).double(), shown - expected, atol=1e-6, rtol=0)
