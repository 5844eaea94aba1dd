"""The inputs that networks see of a frame."""

from __future__ import annotations

import pytest
import torch

from mcdenoise.frame import Frame
from mcdenoise.nn import auto_exposure, normalize_depth
from mcdenoise.nn.inputs import FEATURES, guides_of, image_statistics, input_of


def test_auto_exposure_brings_a_constant_image_to_the_key() -> None:
    color = torch.full((1, 3, 20, 20), 8.0)
    torch.testing.assert_close(auto_exposure(color, key=0.5), torch.full((1, 1, 1, 1), 0.0625))
    assert auto_exposure(torch.zeros(2, 3, 5, 5)).flatten().tolist() == [1, 1]


def test_normalized_depth_written_out() -> None:
    # The geometric mean of 1 and 4 is 2.
    depth = torch.tensor([1.0, 4.0, torch.inf]).reshape(1, 1, 1, 3)
    torch.testing.assert_close(normalize_depth(depth).flatten(), torch.tensor([1 / 3, 2 / 3, 1.0]))
    assert normalize_depth(torch.full((1, 1, 2, 2), torch.inf)).unique().tolist() == [1]


def test_an_input_written_out() -> None:
    color, current, albedo, normal = torch.rand(4, 2, 3, 5, 6, dtype=torch.float64)
    depth, length = 1 + torch.rand(2, 2, 1, 5, 6, dtype=torch.float64)
    frame = Frame(color, albedo=albedo, normal=2 * normal - 1, depth=depth, current=current, length=length)
    frame = frame.replace(statistics=image_statistics(frame))
    exposure = auto_exposure(color)
    assert torch.equal(frame.statistics["exposure"], exposure)
    typical = depth.log().mean((1, 2, 3), keepdim=True).exp()
    near = depth / (depth + typical)
    expected = [color.log1p(), albedo, normal, near, (current * exposure).log1p(), 1 / length]
    given = input_of(frame, color)
    assert given.shape[1] == 3 + FEATURES
    torch.testing.assert_close(given, torch.cat(expected, 1), rtol=1e-12, atol=1e-12)
    for guide, image in zip(guides_of(frame), (normal, near), strict=True):
        torch.testing.assert_close(guide, image, rtol=1e-12, atol=1e-12)


def test_a_buffer_that_is_not_there_is_constant() -> None:
    frame = Frame(torch.rand(1, 3, 5, 6))
    frame = frame.replace(statistics=image_statistics(frame))
    given = input_of(frame, frame.color)
    assert given[:, 3:6].unique().tolist() == [1]
    assert given[:, 6:9].unique().tolist() == [0.5]
    assert given[:, 9].unique().tolist() == [0.5]
    assert torch.equal(given[:, 10:13], (frame.color * frame.statistics["exposure"]).log1p())
    assert given[:, 13].unique().tolist() == [1]


def test_a_second_network_takes_the_statistics_of_the_first() -> None:
    given = {"exposure": torch.full((1, 1, 1, 1), 3.0), "depth_scale": torch.tensor([2.0, 0.5]).reshape(1, 2, 1, 1)}
    found = image_statistics(Frame(torch.rand(1, 3, 5, 6), statistics=given))
    assert all(found[name] is value for name, value in given.items())
    assert image_statistics(Frame(torch.rand(1, 3, 5, 6)))["depth_scale"].flatten().tolist() == pytest.approx([1, 1])
