"""The inputs that networks see of a frame."""

import torch

from mcdenoise.frame import Frame
from mcdenoise.nn import auto_exposure, normalize_depth
from mcdenoise.nn.inputs import image_statistics, input_of


def test_auto_exposure_brings_a_constant_image_to_the_key() -> None:
    color = torch.full((1, 3, 20, 20), 8.0)
    torch.testing.assert_close(auto_exposure(color, key=0.5), torch.full((1, 1, 1, 1), 0.0625))
    assert auto_exposure(torch.zeros(2, 3, 5, 5)).flatten().tolist() == [1, 1]


def test_normalized_depth_written_out() -> None:
    # The geometric mean of 1 and 4 is 2.
    depth = torch.tensor([1.0, 4.0, torch.inf]).reshape(1, 1, 1, 3)
    torch.testing.assert_close(normalize_depth(depth).flatten(), torch.tensor([1 / 3, 2 / 3, 1.0]))
    assert normalize_depth(torch.full((1, 1, 2, 2), torch.inf)).unique().tolist() == [1]


def test_a_buffer_that_is_not_there_is_constant() -> None:
    frame = Frame(torch.rand(1, 3, 5, 6))
    frame = frame.replace(statistics=image_statistics(frame))
    given = input_of(frame, frame.color)
    assert given[:, 3:6].unique().tolist() == [1]
    assert given[:, 6:9].unique().tolist() == [0.5]
    assert given[:, 9].unique().tolist() == [0.5]
    assert torch.equal(given[:, 10:13], (frame.color * frame.statistics["exposure"]).log1p())
    assert given[:, 13].unique().tolist() == [1]
