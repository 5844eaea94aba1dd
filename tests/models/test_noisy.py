"""Doing nothing, and accumulation alone."""

import torch

from mcdenoise.denoiser import Denoiser
from mcdenoise.frame import Frame
from mcdenoise.models import Accumulated
from mcdenoise.models._wrapper import parts_of
from mcdenoise.models.noisy import Noisy


def frame(height: int = 18, width: int = 22) -> Frame:
    """A new sample of a still grey wall: mean 1 in each channel, albedo a half."""
    light = -torch.log(torch.rand(1, 3, height, width).clamp_min(1e-6))
    return Frame(
        color=0.5 * light,
        albedo=torch.full_like(light, 0.5),
        normal=torch.tensor([0.0, 0.0, 1.0]).reshape(1, 3, 1, 1).expand_as(light).contiguous(),
        depth=torch.full_like(light[:, :1], 2.0),
        motion=torch.zeros(1, 2, height, width),
    )


def test_noisy_is_the_color_itself() -> None:
    given = frame()
    denoiser = Denoiser("noisy")
    result = denoiser(given)
    assert torch.equal(result, given.color)
    assert result.data_ptr() != given.color.data_ptr()
    assert Noisy().needs.missing(Frame(color=given.color)) == []
    assert not Noisy().needs.trainable
    assert Noisy().needs.reach == 0


def test_the_variance_of_a_still_shot_falls_with_the_number_of_frames() -> None:
    """Equal weights until alpha_min: after n frames the variance is one n-th, of 396 pixels and 3 channels."""
    torch.manual_seed(0)
    denoiser = Denoiser("accumulated", alpha_min=0.01, anti_lag=False)
    (accumulated,) = parts_of(denoiser.model, Accumulated)
    accumulated.firefly_limit = torch.inf
    for number in range(1, 17):
        result = denoiser(frame())
        expected = 0.25 / number
        # An estimate of the variance from N exponential samples has a relative deviation of sqrt(8 / N) at most.
        assert abs(result.var().item() / expected - 1) < 5 * (8 / result.numel()) ** 0.5
    assert denoiser.report.reset == ""
