"""The recurrent autoencoder against its equations, and what it remembers."""

from typing import Any

import pytest
import torch
from torch import Tensor, nn
from toys import frame_of

from mcdenoise import Frame
from mcdenoise.models.rae import Rae, view_normal

SIZE = (7, 9)


def drawn() -> Any:
    """Narrow, in float64, with biases of which something is felt."""
    torch.manual_seed(2)
    model = Rae(4).double()
    for parameter in model.parameters():
        if parameter.dim() == 1:
            nn.init.normal_(parameter, 0.1, std=0.1)
    # Few pixels are cut off.
    nn.init.constant_(model.decoder[-1][-1].bias, 0.7)
    return model


def shot(frames: int = 3, size: tuple[int, int] = SIZE) -> list[Frame]:
    """Other noise in each frame; nothing moves."""
    motion = torch.zeros(1, 2, *size)
    found = [frame_of(*size, seed=seed, motion=motion, roughness=torch.rand(1, 1, *size)) for seed in range(frames)]
    same = {"normal": found[0].normal, "depth": found[0].depth}
    return [frame.replace(**same).to(torch.float64) for frame in found]


def turned() -> Tensor:
    """Axes of a camera, in rows: right, down, ahead."""
    axes, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(4)))
    return axes


@pytest.mark.parametrize("perspective", [True, False])
def test_the_normal_is_along_the_axes_of_the_image(perspective: bool) -> None:
    right, down, ahead = turned()
    matrix = torch.zeros(1, 4, 4)
    # The right lower corner of a larger image: clip x and y have a part of w.
    matrix[0, :3, 0], matrix[0, :3, 1] = 1.7 * right, 2.9 * down
    if perspective:
        matrix[0, :3, 0] += 0.6 * ahead
        matrix[0, :3, 1] -= 1.1 * ahead
        matrix[0, :3, 3] = 3 * ahead
    else:
        matrix[0, 3, 3] = 1
    frame = frame_of(4, 5, view_projection=matrix)
    expected = torch.einsum("ac,bchw->bahw", torch.stack([right, down]), frame.normal)
    torch.testing.assert_close(view_normal(frame), expected)
    assert torch.equal(view_normal(frame.replace(view_projection=None)), frame.normal[:, :2])


@torch.no_grad()
def test_a_cut_begins_anew_in_each_image_of_a_batch() -> None:
    model = drawn()
    first, second, _ = shot()
    _, state = model(Frame(**{name: buffer.repeat(2, 1, 1, 1) for name, buffer in first.items()}))
    motion = torch.cat([second.motion, torch.full_like(second.motion, 1e3)])
    both = Frame(**{name: buffer.repeat(2, 1, 1, 1) for name, buffer in second.items()}).replace(motion=motion)
    output, _ = model(both, state)
    torch.testing.assert_close(output.image[:1], model(second, model(first)[1])[0].image)
    torch.testing.assert_close(output.image[1:], model(second)[0].image)


@torch.no_grad()
def test_without_motion_there_is_no_cut() -> None:
    model = drawn()
    first, second, _ = (frame.replace(motion=None) for frame in shot())
    assert not torch.allclose(model(second, model(first)[1])[0].image, model(second)[0].image, rtol=1e-3)
