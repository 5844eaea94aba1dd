"""The accumulated past of a shot."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from mcdenoise.buffers import Frame
from mcdenoise.data import open_sequence
from mcdenoise.history import History
from mcdenoise.ops import Accumulate, ClampFireflies, HistoryLag, accumulate, demodulate, remodulate, use

HEIGHT, WIDTH = 5, 6


@pytest.fixture
def backend(request: pytest.FixtureRequest) -> Iterator[None]:
    with use(request.param):
        yield


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
    history = History(anti_lag=HistoryLag(math.inf))
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


def test_what_moves_keeps_its_past() -> None:
    """A wall comes closer, by more than the limit for positions; the camera stands still."""
    matrix = torch.eye(4)[None]
    matrix[:, 2, 3], matrix[:, 3, 3] = 1, 0  # clip w = z

    def wall(z: float, before: float | None) -> Frame:
        y, x = torch.meshgrid((torch.arange(10) + 0.5) / 5 - 1, (torch.arange(10) + 0.5) / 5 - 1, indexing="ij")
        position = torch.stack([x * z, y * z, torch.full_like(x, z)])[None]
        previous = position.clone()
        previous[:, 2] = z if before is None else before
        return Frame(
            color=torch.ones(1, 3, 10, 10),
            normal=torch.tensor([0.0, 0.0, -1.0]).reshape(1, 3, 1, 1).expand(1, 3, 10, 10),
            position=position,
            previous_position=None if before is None else previous,
            view_projection=matrix,
        )

    for moves in (True, False):
        history = History()
        history.update(wall(2.0, 2.0))
        past = history.update(wall(1.8, 2.0 if moves else None))
        assert past.reset == ("" if moves else "cut")
        if moves:
            assert past.length.unique().tolist() == [2]


def test_motion_goes_before_previous_positions() -> None:
    history = History()
    buffers = {"previous_position": constant(3, 100.0), "view_projection": torch.eye(4)[None]}
    history.update(still(constant(3), **buffers))
    assert history.update(still(constant(3), **buffers)).length.unique().tolist() == [2]


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


# Fireflies


def with_firefly(albedo: float) -> list[Tensor]:
    """Four frames of light 1 on a surface; the first has a firefly in one pixel."""
    colors = [constant(3, albedo, (9, 9)) for _ in range(4)]
    colors[0][..., 4, 4] *= 1e4
    return colors


@pytest.mark.parametrize("with_albedo", [True, False])
def test_a_firefly_does_not_survive(with_albedo: bool) -> None:
    history, albedo = History(Accumulate(0.1)), 0.5 if with_albedo else 1.0
    buffers = {"albedo": constant(3, albedo, (9, 9))} if with_albedo else {}
    for number, color in enumerate(with_firefly(albedo)):
        past = history.update(still(color, **buffers))
        assert past.color[..., 4, 4].unique().item() == pytest.approx(1 + 14 / (number + 1), rel=1e-5)
    # Nothing else differs.
    past.color[..., 4, 4] = 1
    torch.testing.assert_close(past.color, constant(3, 1.0, (9, 9)))


def test_a_dark_texture_beside_a_bright_one_is_no_firefly() -> None:
    """What is clamped is the light: a white pixel among black ones, both lit alike, is as bright as its neighbours."""
    albedo = constant(3, 0.04, (9, 9))
    albedo[..., 4, 4] = 0.9
    past = History().update(still(2 * albedo, albedo=albedo))
    torch.testing.assert_close(past.color, constant(3, 2.0, (9, 9)))


def test_an_infinite_limit_leaves_fireflies() -> None:
    history, colors = History(Accumulate(0.1), ClampFireflies(math.inf)), with_firefly(0.5)
    albedo = constant(3, 0.5, (9, 9))
    for color in colors:
        past = history.update(still(color, albedo=albedo))
    torch.testing.assert_close(past.color, demodulate(sum(colors) / 4, albedo))


def caustics(share: float, size: tuple[int, int] = (128, 160)) -> Frame:
    """Light 1, and in one pixel of 200 as much that all of these have ``share`` of it."""
    hit = torch.rand(1, 1, *size, generator=torch.Generator().manual_seed(0)) < 1 / 200
    return still(torch.where(hit, 200 * share / (1 - share), 1.0).expand(1, 3, *size))


@pytest.mark.parametrize(("share", "kept"), [(0.1, False), (0.3, True)])
def test_where_fireflies_are_much_of_the_light_they_are_caustics(share: float, kept: bool) -> None:
    frame, history = caustics(share), History()
    past = history.update(frame)
    assert torch.equal(past.current, frame.color) is kept
    # For the whole shot, and no longer.
    assert torch.equal(history.update(caustics(0.1)).current, caustics(0.1).color) is kept
    history.reset()
    assert not torch.equal(history.update(caustics(0.1)).current, caustics(0.1).color)


@pytest.mark.parametrize("backend", ["torch", "numba"], indirect=True)
def test_each_image_of_a_batch_and_each_shot_has_its_own_caustics(backend: None) -> None:
    """As if every image were alone; at a cut, which positions tell, the first frame of the next shot counts."""
    few, many = caustics(0.1), caustics(0.3)

    def shot(*images: Frame, x: float = 0.0) -> Frame:
        position = constant(3, 1.0, (128, 160)).repeat(len(images), 1, 1, 1) + x
        camera = torch.eye(4).repeat(len(images), 1, 1)
        return Frame(torch.cat([image.color for image in images]), position=position, view_projection=camera)

    history = History()
    past = history.update(shot(few, many))
    for image, kept in ((few, False), (many, True)):
        alone = History().update(shot(image)).current
        assert torch.equal(alone, image.color) is kept
        torch.testing.assert_close(past.current[int(kept)][None], alone, rtol=0, atol=0)
    past = history.update(shot(many, few, x=1000.0))
    assert past.reset == "cut"
    assert [torch.equal(*both) for both in zip(past.current, (many.color[0], few.color[0]), strict=True)] == [
        True,
        False,
    ]
    torch.testing.assert_close(past.color, past.current, rtol=0, atol=0)


def test_one_firefly_is_no_caustic_however_bright() -> None:
    color = constant(3, 1.0, (128, 160))
    color[..., 64, 80] = 1e9
    assert History().update(still(color)).current.max() == pytest.approx(15)


def test_who_names_a_limit_gets_it() -> None:
    frame = caustics(0.3)
    assert not torch.equal(History(fireflies=ClampFireflies(15)).update(frame).current, frame.color)


# Mirrors and glass

LONG = 12


def mirror_in_a_pan(pixels: int) -> list[Frame]:
    """A mirror two pixels wide on a diffuse wall, both noisy, that move left by ``pixels`` a frame."""
    frames, generator = [], torch.Generator().manual_seed(0)
    motion = torch.tensor([float(pixels), 0.0]).reshape(1, 2, 1, 1).expand(1, 2, 3, 24)
    for number in range(6):
        albedo = constant(3, 0.5, (3, 24))
        left = 16 - pixels * number
        albedo[..., left : left + 2] = 0
        color = torch.rand(1, 3, 3, 24, generator=generator)
        frames.append(Frame(color=color, albedo=albedo, motion=motion))
    return frames


def test_the_past_of_a_mirror_that_moves_is_short() -> None:
    history, last = History(), None
    for number, frame in enumerate(mirror_in_a_pan(2)):
        past = history.update(frame)
        assert frame.albedo is not None
        mirror = (frame.albedo == 0).all(1, keepdim=True)
        assert past.length[mirror].unique().tolist() == [min(number + 1, 3)]
        if number > 2 and last is not None:
            expected = torch.lerp(frame.color, last.color.roll(-2, -1), 2 / 3)
            torch.testing.assert_close(past.color * mirror, expected * mirror)
        last = past


def test_what_is_diffuse_keeps_its_past_beside_a_mirror() -> None:
    """The mirror moves by its width: where it is now, the past was diffuse, and where it was, the present is."""
    history, everything_alike = History(), History(specular_length=math.inf)
    for number, frame in enumerate(mirror_in_a_pan(2)):
        past, alike = history.update(frame), everything_alike.update(frame)
        assert frame.albedo is not None
        diffuse = (frame.albedo > 0).all(1, keepdim=True)
        assert torch.equal(past.length[diffuse], alike.length[diffuse])
        assert torch.equal(past.color * diffuse, alike.color * diffuse)
        assert alike.length.max() == number + 1


def test_the_past_of_a_mirror_that_stands_still_grows() -> None:
    history, everything_alike = History(), History(specular_length=math.inf)
    for number, frame in enumerate(mirror_in_a_pan(0), start=1):
        # Less than what counts as motion.
        frame = frame.replace(motion=torch.full_like(frame.color[:, :2], 0.03))
        past, alike = history.update(frame), everything_alike.update(frame)
        assert past.length.max().item() == pytest.approx(number)
        assert torch.equal(past.length, alike.length)
        assert torch.equal(past.color, alike.color)


@pytest.mark.parametrize("alpha_min", [0.1, 0.4, 1.0])
@pytest.mark.parametrize("longest", [0, 1, 2.5, 20])
def test_a_shortened_past_is_that_of_a_shorter_history(alpha_min: float, longest: float) -> None:
    history, albedo = History(Accumulate(alpha_min), specular_length=longest), constant(3, 0.0)
    for _ in range(LONG):
        before = history.update(still(torch.rand(1, 3, HEIGHT, WIDTH), albedo=albedo))
    assert before.length.unique().tolist() == [LONG]
    color, motion = torch.rand(1, 3, HEIGHT, WIDTH), torch.full((1, 2, HEIGHT, WIDTH), 0.25)
    past = history.update(Frame(color=color, albedo=albedo, motion=motion))
    length = before.length.clamp_max(longest)
    expected = accumulate(color, before.color, length, motion, alpha_min=alpha_min)
    torch.testing.assert_close(past.color, expected[0])
    torch.testing.assert_close(past.length, expected[1])
    # No past at all is not a cut: nothing says that the scene has changed.
    assert past.reset == ""


def test_without_albedo_nothing_is_known_of_mirrors() -> None:
    history = History()
    motion = torch.full((1, 2, HEIGHT, WIDTH), 0.25)
    for number in range(1, 6):
        past = history.update(Frame(color=torch.rand(1, 3, HEIGHT, WIDTH), motion=motion))
        assert past.length.max().item() == pytest.approx(number)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_mirror_of_unknown_motion_starts_anew(value: float) -> None:
    history, motion = History(), torch.zeros(1, 2, HEIGHT, WIDTH)
    motion[:, 0, 1, 1] = value
    for number in range(1, 6):
        color = torch.rand(1, 3, HEIGHT, WIDTH)
        past = history.update(Frame(color=color, albedo=constant(3, 0.0), motion=motion))
        assert torch.equal(past.color[..., 1, 1], color[..., 1, 1])
        assert past.color.isfinite().all()
        assert past.length[0, 0, 1, 1] == 1
        assert past.length.max() == number


@pytest.mark.parametrize("length", [-1.0, math.nan])
def test_a_past_of_negative_length_is_refused(length: float) -> None:
    with pytest.raises(ValueError, match=f"specular_length: expected at least 0, found {length}"):
        History(specular_length=length)


# Lights in the plane of what is around them


def seen_in_passing(number: int, size: tuple[int, int] = (48, 64)) -> Frame:
    """A wall of uniform noise that moves by fractions of a pixel, without color."""
    height, width = size
    shift = torch.tensor([0.37, 0.21], dtype=torch.float64)
    rows, columns = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    position = torch.stack([columns + shift[0] * number, rows + shift[1] * number, torch.full_like(rows, 50.0)])[None]
    return Frame(
        color=torch.rand(1, 3, height, width, generator=torch.Generator().manual_seed(number)),
        position=position.float(),
        normal=torch.tensor([0.0, 0.0, -1.0]).reshape(1, 3, 1, 1).expand(1, 3, height, width),
        depth=torch.full((1, 1, height, width), 50.0),
        motion=shift.float().reshape(1, 2, 1, 1).expand(1, 2, height, width),
    )


@pytest.mark.parametrize("backend", ["torch", "numba"], indirect=True)
def test_a_lamp_does_not_bleed_into_the_ceiling_around_it(backend: None) -> None:
    """Same plane, no albedo: only their light tells one from the other."""
    history, without = History(), History(anti_lag=HistoryLag(math.inf))
    for number in range(12):
        frame = seen_in_passing(number)
        assert frame.position is not None
        offset = (frame.position[:, :2] - torch.tensor([34.0, 27.0]).reshape(1, 2, 1, 1)).abs()
        lamp = (offset[:, :1] < 9) & (offset[:, 1:] < 5)
        frame = frame.replace(color=torch.where(lamp, 40.0, frame.color))
        past, bled = history.update(frame), without.update(frame)
        assert (past.color * ~lamp).max() <= 1
        assert ((past.color - 40) * lamp).abs().max() < 1e-3
    # Nor does it cost any of the past.
    assert past.length[..., 12:-12, 12:-12].min() > 11.9
    assert (bled.color * ~lamp).max() > 5


@pytest.mark.parametrize("share", [0.1, 0.25, 0.5, 0.75])
def test_samples_of_one_brightness_are_no_lights(share: float) -> None:
    """One of a few small lights is drawn: beside each other there are often alike samples, and no light may be lost."""
    history, means = History(fireflies=ClampFireflies(math.inf)), []
    for number in range(24):
        frame = seen_in_passing(number, (96, 128))
        lit = frame.color[:, :1] < share
        past = history.update(frame.replace(color=torch.where(lit, 1.0, 0.02).expand_as(frame.color)))
        means.append(past.color[..., 16:-16, 16:-16].mean().item())
    expected = share + 0.02 * (1 - share)
    assert sum(means[12:]) / 12 == pytest.approx(expected, rel=0.01)
    assert all(mean == pytest.approx(expected, rel=0.05) for mean in means)


# What a scene does not need


def wall(color: Tensor, **buffers: Any) -> Frame:
    """A wall seen by the same camera in every frame; its positions are those of the pixels, with their rounding."""
    height, width = color.shape[-2:]
    rows, columns = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    camera = torch.diag(torch.tensor([1 / 1.7, 1 / 1.3, 1.0, 0.0]))
    camera[2, 3] = 1.0
    position = torch.stack([(2 * columns / width - 1) * 1.7, (2 * rows / height - 1) * 1.3, torch.ones_like(rows)])[
        None
    ]
    return Frame(color=color, **{"position": position * 3, "view_projection": camera[None], **buffers})


def test_a_still_frame_is_known_by_its_motion_or_by_camera_and_positions() -> None:
    history, color = History(), torch.rand(1, 3, 20, 30)
    assert not history.is_still(wall(color))
    history.update(wall(color))
    frame = wall(color)
    assert frame.position is not None
    assert history.is_still(frame)
    assert history.is_still(frame.replace(previous_position=frame.position.clone()))
    moved = frame.position.clone()
    moved[0, 2, 13, 17] += 1e-3
    assert not history.is_still(frame.replace(previous_position=moved))
    assert frame.view_projection is not None
    assert not history.is_still(frame.replace(view_projection=frame.view_projection * 1.0001))
    assert history.is_still(still(color))
    motion = torch.zeros(1, 2, 20, 30)
    motion[0, 1, 13, 17] = 1e-6
    assert not history.is_still(still(color, motion=motion))
    # The frame's own motion goes before its positions.
    assert not history.is_still(frame.replace(motion=motion))
    assert not history.is_still(Frame(color=color))


@pytest.mark.parametrize("size", [(20, 30), (96, 110)])
def test_a_still_frame_needs_no_reprojection_to_the_last_bit(size: tuple[int, int]) -> None:
    ordinary, short = History(), History()
    normal = constant(3, 0.6, size)
    albedo = constant(3, 0.5, size)
    albedo[..., : size[1] // 3] = 0
    for number in range(14):
        # A thing appears where there was a wall, without being told: its past is not the wall's.
        normal = normal.clone()
        normal[..., 5:9, number : number + 4] *= -1
        color = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(number))
        frame = wall(color, normal=normal, albedo=albedo)
        assert short.is_still(frame) == (number > 0)
        past = ordinary.update(frame)
        again = short.update(frame, reprojects=not short.is_still(frame))
        assert all(torch.equal(a, b) for a, b in zip(past[:3], again[:3], strict=True))
        assert past.reset == again.reset
    assert 1 in past.length
    assert past.length.max() == 14


def test_a_still_wall_is_averaged_pixel_by_pixel() -> None:
    history, colors = History(), torch.rand(8, 1, 3, 20, 30)
    for color in colors:
        past = history.update(wall(color))
    # To the rounding of the average: no pixel has anything of its neighbours.
    torch.testing.assert_close(past.color, colors.mean(0), rtol=1e-6, atol=1e-7)


def test_an_albedo_of_one_or_of_nothing_needs_no_demodulation() -> None:
    for albedo in (constant(3), constant(3, 0.0)):
        ordinary, short = History(), History()
        for color in torch.rand(3, 1, 3, HEIGHT, WIDTH):
            frame = still(color, albedo=albedo, motion=constant(2, 0.3))
            results = ordinary.update(frame), short.update(frame, demodulates=False)
            assert all(torch.equal(a, b) for a, b in zip(*(result[:3] for result in results), strict=True))


def test_a_frame_that_is_not_kept_is_no_past() -> None:
    history = History()
    color = torch.rand(1, 3, HEIGHT, WIDTH)
    history.update(still(color))
    last = history.update(still(color), keeps=False)
    assert last.length.unique().tolist() == [2]
    assert history.update(still(color)).reset == "first frame"


# Changes of light


def switched(off_at: int, count: int, level: float = 0.0) -> list[Frame]:
    """Noisy light that falls to ``level``; nothing moves."""
    g, frames = torch.Generator().manual_seed(0), []
    for number in range(count):
        noise = -torch.log(torch.rand(1, 3, 16, 16, generator=g).clamp_min(1e-6))
        frames.append(still(noise if number < off_at else level * noise))
    return frames


@pytest.mark.parametrize("level", [0.0, 0.1])
def test_the_past_is_given_up_where_the_light_changes(level: float) -> None:
    lagging, history = History(anti_lag=HistoryLag(math.inf)), History()
    for frame in switched(20, 21, level):
        ghost, past = lagging.update(frame), history.update(frame)
    # A tenth of the new light, nine of the old; and nothing but the new one.
    assert abs(ghost.color.mean() - (0.1 * level + 0.9)) < 0.1
    torch.testing.assert_close(past.color, frame.color, rtol=0.2, atol=0.05 * level)
    assert past.length.max() <= 4
    assert past.reset == ""


def test_brighter_light_comes_sooner() -> None:
    """The brighter it is, the more noise there is to hide the change: some frames are needed."""
    lagging, history = History(anti_lag=HistoryLag(math.inf)), History()
    for frame in switched(20, 24, 5.0):
        expected, past = lagging.update(frame), history.update(frame)
    assert expected.color.mean() < 2.5
    assert past.color.mean() > 4


def test_steady_light_keeps_its_past() -> None:
    lagging, history = History(anti_lag=HistoryLag(math.inf)), History()
    for frame in switched(20, 20):
        expected, past = lagging.update(frame), history.update(frame)
    torch.testing.assert_close(past.color, expected.color)
    assert torch.equal(past.length, expected.length)


def test_after_a_change_a_new_past_grows() -> None:
    history = History()
    for frame in switched(20, 30, 0.2):
        past = history.update(frame)
    assert past.length.min() > 9
    assert abs(past.color.mean() - 0.2) < 0.02


@pytest.mark.parametrize("pixels", [2 * 16, 100])
def test_the_past_is_the_same_a_few_rows_at_a_time(pixels: int, monkeypatch: pytest.MonkeyPatch) -> None:
    g, frames = torch.Generator().manual_seed(1), switched(6, 9, 0.3)
    albedo = torch.rand(1, 3, 16, 16, generator=g) * (torch.rand(1, 1, 16, 16, generator=g) > 0.2)
    motion = torch.rand(1, 2, 16, 16, generator=g) - 0.5
    frames = [frame.replace(albedo=albedo, motion=motion) for frame in frames]
    whole, bands = History(), History()
    expected = [whole.update(frame) for frame in frames]
    assert expected[-1].length.max() < 9
    monkeypatch.setattr("mcdenoise.ops._rows._PIXELS", pixels)
    for frame, past in zip(frames, expected, strict=True):
        found = bands.update(frame)
        assert torch.equal(found.color, past.color)
        assert torch.equal(found.length, past.length)


def test_a_first_frame_a_cut_and_another_size_begin_a_recent_past_too() -> None:
    history, fresh = History(), History()
    floor = torch.tensor([0.0, 1.0, 0.0]).reshape(1, 3, 1, 1).expand(1, 3, HEIGHT, WIDTH)
    for frame in (still(constant(3, 9.0, (4, 4))), still(constant(3, 5.0), normal=floor.roll(1, 1))):
        history.update(frame)
    for value in (1.0, 2.0, 3.0):
        frame = still(constant(3, value), normal=floor)
        past, expected = history.update(frame), fresh.update(frame)
        assert torch.equal(past.color, expected.color)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_frames_are_accumulated_in_float32(dtype: torch.dtype) -> None:
    history, twin = (History(Accumulate(1e-6), anti_lag=HistoryLag(math.inf)) for _ in range(2))
    for color in torch.rand(300, 1, 3, 4, 4, generator=torch.Generator().manual_seed(0)).to(dtype):
        past, expected = history.update(still(color)), twin.update(still(color.float()))
    assert past.color.dtype == past.length.dtype == torch.float32
    assert torch.equal(past.color, expected.color)
    # More than bfloat16 can count.
    assert past.length.unique().tolist() == [300]
