"""Doing nothing."""

import torch

from mcdenoise.denoiser import Denoiser
from mcdenoise.frame import Frame
from mcdenoise.models import Needs
from mcdenoise.models.noisy import Noisy


def test_noisy_is_the_color_itself() -> None:
    color = torch.rand(1, 3, 18, 22)
    result = Denoiser("noisy")(Frame(color))
    assert torch.equal(result, color)
    assert result.data_ptr() != color.data_ptr()
    assert Noisy().needs == Needs(trainable=False, reach=0)
