"""The accumulated past of a shot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from mcdenoise.buffers import Frame
from mcdenoise.data import open_sequence
from mcdenoise.history import History
from mcdenoise.ops import Accumulate, demodulate, remodulate

HEIGHT, WIDTH = 5, 6


def constant(channels: int, value: float = 1.0, size: tuple[int, int] = (HEIGHT, WIDTH)) -> Tensor:
    return torch.full((1, channels, *size), value)


def still(color: Tensor, **buffers: Any) -> Frame:
    """A frame of a scene in which nothing moves."""
    return Frame(color=color, **{"motion": torch.zeros_like(color[:, :2]), **buffers})


def test_the_first_frame_is_itself() -> None:
    color = torch.rand(1, 3, HEIGHT, WIDTH)
    past = History().update(still(color))
    assert torch.equal(past.color, color)
    assert past.length.unique().tolist() == [1]
    assert past.reset == "first frame"


def test_a_still_shot_is_averaged() -> None:
    history, colors = History(Accumulate(0.1)), torch.rand(10, 1, 3, HEIGHT, WIDTH)
    for i, color in enumerate(colors, start=1):
        past = history.update(still(color))
        torch.testing.assert_close(past.color, colors[:i].mean(0))
        assert past.length.unique().tolist() == [i]
        assert past.reset == ("first frame" if i == 1 else "")
    # From here on the window is exponential: one tenth of the frame, nine tenths of the past.
    color = torch.rand(1, 3, HEIGHT, WIDTH)
    torch.testing.assert_close(history.update(still(color)).color, 0.1 * color + 0.9 * colors.mean(0))


def test_albedo_is_divided_out_before_averaging() -> None:
    history = History()
    albedo, color = torch.rand(1, 3, HEIGHT, WIDTH) + 0.1, torch.rand(2, 1, 3, HEIGHT, WIDTH)
    for one in color:
        past = history.update(still(one, albedo=albedo))
    torch.testing.assert_close(past.color, demodulate(color.mean(0), albedo))


def test_reset_makes_the_next_frame_the_first() -> None:
    history, color = History(), torch.rand(1, 3, HEIGHT, WIDTH)
    history.update(still(color + 1))
    history.reset()
    past = history.update(still(color))
    assert torch.equal(past.color, color)
    assert past.reset == "first frame"


def test_another_size_resets() -> None:
    history = History()
    history.update(still(constant(3)))
    smaller = constant(3, 2.0, (4, 4))
    past = history.update(still(smaller))
    assert torch.equal(past.color, smaller)
    assert past.reset == "size change"
    assert history.update(still(smaller)).reset == ""


def test_a_cut_resets() -> None:
    history = History()
    floor = torch.tensor([0.0, 1.0, 0.0]).reshape(1, 3, 1, 1).expand(1, 3, HEIGHT, WIDTH)
    wall = floor.roll(1, 1)
    history.update(still(constant(3), normal=floor))
    history.update(still(constant(3), normal=floor))
    past = history.update(still(constant(3, 2.0), normal=wall))
    assert past.reset == "cut"
    assert past.color.unique().tolist() == [2]
    assert past.length.unique().tolist() == [1]
    assert history.update(still(constant(3, 2.0), normal=wall)).length.unique().tolist() == [2]


def test_what_was_hidden_starts_anew_without_a_cut() -> None:
    history = History()
    near, uncovered = constant(1, 2.0), constant(1, 2.0)
    uncovered[..., : WIDTH // 2] = 9.0
    history.update(still(constant(3), depth=near))
    past = history.update(still(constant(3, 3.0), depth=uncovered))
    assert past.reset == ""
    assert past.length[0, 0, 0].tolist() == [1, 1, 1, 2, 2, 2]
    assert past.color[0, 0, 0].tolist() == [3, 3, 3, 2, 2, 2]


def test_without_motion_every_frame_stands_alone() -> None:
    history = History()
    for value in (1.0, 2.0):
        past = history.update(Frame(color=constant(3, value), depth=constant(1)))
        assert past.color.unique().tolist() == [value]
    assert past.reset == "no motion, and no position with a previous camera"


def test_a_frame_without_camera_is_no_past_for_positions() -> None:
    history = History()
    position, camera = torch.rand(1, 3, HEIGHT, WIDTH), torch.eye(4)[None]
    history.update(Frame(color=constant(3), position=position))
    past = history.update(Frame(color=constant(3), position=position, view_projection=camera))
    assert past.reset.startswith("no motion")


def test_the_motion_of_the_renderer_is_followed() -> None:
    history = History()
    columns = torch.arange(float(WIDTH)).expand(1, 3, HEIGHT, WIDTH)
    motion = torch.tensor([1.0, 0.0]).reshape(1, 2, 1, 1).expand(1, 2, HEIGHT, WIDTH)
    history.update(Frame(color=columns, motion=motion))
    past = history.update(Frame(color=constant(3, 10.0), motion=motion))
    # Half of the new frame, and half of the old pixel on the right; the last column came into view.
    assert past.color[0, 0, 0].tolist() == [5.5, 6.0, 6.5, 7.0, 7.5, 10.0]
    assert past.length[0, 0, 0].tolist() == [2, 2, 2, 2, 2, 1]


def test_motion_goes_before_positions() -> None:
    history = History()
    # Seen from this camera, every position is out of view.
    buffers = {"position": constant(3, 100.0), "view_projection": torch.eye(4)[None]}
    history.update(still(constant(3), **buffers))
    assert history.update(still(constant(3), **buffers)).length.unique().tolist() == [2]


@pytest.mark.parametrize("alpha_min", [0.1, 0.25])
def test_accumulation_reduces_the_error_of_a_moving_camera(small_sequence: Path, alpha_min: float) -> None:
    sequence, history = open_sequence(small_sequence), History(Accumulate(alpha_min))
    for number in sequence.numbers:
        frame = sequence.frame(number)
        past = history.update(frame)
        assert past.reset == ("first frame" if number == 0 else "")
    assert frame.albedo is not None
    assert frame.depth is not None
    assert frame.reference is not None
    floor = torch.isfinite(frame.depth) & (past.length > 3)
    assert floor.float().mean() > 0.3
    accumulated = remodulate(past.color, frame.albedo)
    raw, after = ((image - frame.reference).square() * floor for image in (frame.color, accumulated))
    # Four frames of independent noise: a quarter of the variance, and a little bias from resampling.
    assert after.sum() < 0.4 * raw.sum()


def test_the_background_has_a_past(small_sequence: Path) -> None:
    sequence, history = open_sequence(small_sequence), History()
    for number in sequence.numbers:
        frame = sequence.frame(number)
        past = history.update(frame)
    assert frame.depth is not None
    sky = ~torch.isfinite(frame.depth)
    assert sky.float().mean() > 0.1
    assert (past.length[sky] > 1).float().mean() > 0.8
    # It has no noise and one color, which blending must not change.
    torch.testing.assert_close(past.color * sky, frame.color * sky)


def test_another_surface_at_the_same_pixel_is_no_past_even_without_depth() -> None:
    """Positions with a camera are enough: depth is what the camera sees of them."""
    matrix = torch.eye(4)[None]
    matrix[:, 2, 3], matrix[:, 3, 3] = 1, 0  # clip w = z

    def wall(z: float) -> Frame:
        y, x = torch.meshgrid(torch.linspace(-0.9, 0.9, 10), torch.linspace(-0.9, 0.9, 10), indexing="ij")
        position = torch.stack([x * z, y * z, torch.full_like(x, z)])[None]
        return Frame(color=torch.ones(1, 3, 10, 10), position=position, view_projection=matrix)

    history = History()
    history.update(wall(2.0))
    assert history.update(wall(2.0)).reset == ""
    assert history.update(wall(9.0)).reset == "cut"


def test_the_published_rule_can_be_asked_for(small_sequence: Path) -> None:
    sequence = open_sequence(small_sequence)
    history = History(Accumulate(0.2, "bmfr", position_limit=1.0, normal_limit=0.25))
    for number in sequence.numbers:
        past = history.update(sequence.frame(number))
    assert past.length.max() == len(sequence)
    nothing_alike = History(Accumulate(0.2, "bmfr", position_limit=0.0, normal_limit=0.25))
    for number in sequence.numbers:
        past = nothing_alike.update(sequence.frame(number))
    assert past.reset == "cut"
