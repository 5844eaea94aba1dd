"""A method that is given its own image of the frame before: where it was, what no longer shows, and how it ends."""

import pytest
import torch
from torch import Tensor

from mcdenoise import Frame
from mcdenoise.frame import Hints
from mcdenoise.models import Needs, Output, Recurrent, State
from mcdenoise.models.recurrent import PREVIOUS, PREVIOUS_WEIGHT
from mcdenoise.ops import Surface, reproject, resample


class Shows:
    """Half of the image of the frame before, and remembers what it was given."""

    needs = Needs(reach=0)

    def __call__(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        self.previous, self.weight = frame.extra[PREVIOUS], frame.extra[PREVIOUS_WEIGHT]
        stays = self.weight / 2
        return Output(torch.lerp(frame.color, self.previous, stays)), None


def moving(color: Tensor, motion: tuple[float, float], depth: Tensor | None = None) -> Frame:
    height, width = color.shape[-2:]
    field = torch.tensor(motion, dtype=torch.float32).reshape(1, 2, 1, 1).expand(1, 2, height, width)
    return Frame(color, motion=field, depth=torch.ones(1, 1, height, width) if depth is None else depth)


def test_a_still_camera_gives_the_exponential_mean() -> None:
    inner, state = Shows(), None
    colors = torch.rand(4, 1, 3, 5, 6)
    for number, color in enumerate(colors):
        output, state = Recurrent(inner)(moving(color, (0, 0)), state)
        assert bool(inner.weight.any()) is bool(inner.previous.any()) is (number > 0)
    expected = (colors[0] + colors[1]) / 8 + colors[2] / 4 + colors[3] / 2
    torch.testing.assert_close(output.image, expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_previous_image_is_resampled_where_all_taps_show_the_same_surface_and_else_interpolated(
    dtype: torch.dtype,
) -> None:
    inner = Shows()
    model = Recurrent(inner)
    first, motion = torch.rand(1, 3, 6, 9).to(dtype), (0.4, 0.3)
    columns = torch.arange(9).expand(1, 1, 6, 9)
    depth = torch.where(columns < 4, 1.0, 3.0)
    _, state = model(moving(first, (0, 0), depth).to(dtype))
    frame = moving(torch.rand(1, 3, 6, 9), motion, depth).to(dtype)
    model(frame, state)
    surface = Surface(depth=frame.depth)
    bilinear, weight = reproject(first, frame.motion, surface, surface)
    bicubic = resample(first, frame.motion)
    # The third column's taps are on both sides of the edge, and those of the last column and row are outside.
    whole = (columns != 3) & (columns != 8) & (torch.arange(6).reshape(1, 1, 6, 1) != 5)
    assert torch.equal(weight > 0.99, whole)
    assert torch.equal(inner.previous, torch.where(whole, bicubic, bilinear))
    assert (bicubic - bilinear).abs()[whole.expand_as(first)].mean() > 0.01


def test_nothing_of_another_surface_is_mixed_in_by_a_tiny_motion() -> None:
    inner = Shows()
    model = Recurrent(inner)
    columns = torch.arange(8).expand(1, 1, 5, 8)
    dim = torch.where(columns < 4, 1.0, 100.0).expand(1, 3, 5, 8)
    frame = moving(dim, (0.0005, 0), torch.where(columns < 4, 1.0, 3.0))
    _, state = model(frame)
    model(frame, state)
    assert (inner.previous[..., 1:4] == 1).all()


def test_pixels_of_another_surface_have_no_previous_image() -> None:
    inner = Shows()
    model = Recurrent(inner)
    near, far = torch.ones(1, 1, 5, 8), torch.full((1, 1, 5, 8), 3.0)
    columns = torch.arange(8).expand(1, 1, 5, 8)
    _, state = model(moving(torch.rand(1, 3, 5, 8), (0, 0), torch.where(columns < 4, near, far)))
    # A pillar that ended at the fourth column now ends at the second.
    model(moving(torch.rand(1, 3, 5, 8), (0, 0), torch.where(columns < 2, near, far)), state)
    assert (inner.weight == (columns < 2) + (columns >= 4)).all()


def test_positions_and_cameras_tell_motion_too() -> None:
    inner = Shows()
    model = Recurrent(inner)
    centers = (torch.arange(8.0) + 0.5) / 4 - 1
    grid = torch.stack(torch.meshgrid(centers, centers, indexing="xy"))
    position = torch.cat([grid, torch.ones(1, 8, 8)])[None]
    # Row vectors: one pixel to the right is a quarter in x.
    camera = torch.eye(4)[None].clone()
    frame = Frame(torch.rand(1, 3, 8, 8), position=position, view_projection=camera)
    _, state = model(frame)
    moved = camera.clone()
    moved[:, 3, 0] = 0.25
    shifted = position - torch.tensor([0.25, 0, 0]).reshape(1, 3, 1, 1)
    model(Frame(torch.rand(1, 3, 8, 8), position=shifted, view_projection=moved), state)
    torch.testing.assert_close(inner.previous[..., 1:], frame.color[..., :-1])


def test_nothing_is_kept_of_the_last_frame() -> None:
    frame = moving(torch.rand(1, 3, 5, 6), (0, 0))
    assert Recurrent(Shows())(frame.replace(hints=Hints(last=True)))[1] is None


def test_the_gradient_goes_through_the_state() -> None:
    model, state = Recurrent(Shows()), None
    colors = [torch.rand(1, 3, 4, 5, dtype=torch.float64, requires_grad=True) for _ in range(3)]
    for color in colors:
        output, state = model(moving(color, (0.25, -0.5)).to(torch.float64).replace(color=color), state)
    inside = output.image[..., 1:-1, 1:-1].sum()
    gradients = torch.autograd.grad(inside, colors)
    # A quarter, a quarter and a half of what is inside; the weights of the pixels that are fetched add up to one.
    assert float(sum(gradient.sum() for gradient in gradients)) == pytest.approx(3 * 2 * 3)
    assert float(gradients[2].sum()) == pytest.approx(3 * 2 * 3 / 2)
