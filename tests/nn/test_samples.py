"""Samples as networks see them, and their embedding, written out."""

import pytest
import torch
from refusals import refused
from torch import nn

from mcdenoise.frame import Frame
from mcdenoise.light import LARGEST_RADIANCE
from mcdenoise.nn.samples import LeakyUNet, samples_of


@pytest.mark.parametrize("convolutions", [1, 3])
@torch.no_grad()
def test_the_reach_of_a_unet(convolutions: int) -> None:
    """No weight is zero, and no unit is dead: what lies within reach is seen from some pixel, and nothing beyond."""
    unet = LeakyUNet(1, 4, convolutions).double()
    for parameter in unet.parameters():
        nn.init.uniform_(parameter, 0.01, 0.1)
    reach = LeakyUNet.reach(convolutions)
    farthest = 0
    for place in range(4):
        image = torch.zeros(1, 1, 4, 4 * reach, dtype=torch.float64)
        changed = image.clone()
        changed[..., 2 * reach // 4 * 4 + place] = 1
        columns = (unet(changed) != unet(image)).any(2).any(1).nonzero()[:, 1] - (2 * reach // 4 * 4 + place)
        farthest = max(farthest, int(columns.abs().max()))
    # Pooled pixels and interpolated ones do not add up to all of the bound in one direction.
    assert reach - 2 * LeakyUNet.multiple <= farthest <= reach


def test_samples_that_are_no_radiance() -> None:
    samples = torch.tensor([-1.0, 2.0, torch.inf, torch.nan, -torch.inf, 0.5]).reshape(1, 2, 3, 1, 1)
    found = samples_of(Frame(torch.ones(1, 3, 1, 1), samples=samples))
    assert found.flatten().tolist() == pytest.approx([0, 2, LARGEST_RADIANCE, 0, 0, 0.5])
    assert "buffer 'samples'" in refused(samples_of, Frame(torch.ones(1, 3, 1, 1), samples=samples[:, :, :2]))
