"""The history of a shot: what is kept of it from frame to frame, and when it ends."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from planes import leaning_wall
from torch import Tensor
from torch.utils import _pytree as pytree
from toys import Mean, Shot, Watching, still, whole_frame

from mcdenoise.data import open_sequence
from mcdenoise.frame import Frame
from mcdenoise.models import Accumulated
from mcdenoise.ops import accumulate, remodulate
from mcdenoise.ops._backend import Backend

HEIGHT, WIDTH = 5, 6


def constant(channels: int, value: float = 1.0, size: tuple[int, int] = (HEIGHT, WIDTH)) -> Tensor:
    return torch.full((1, channels, *size), value)


def test_a_still_shot_is_averaged() -> None:
    history, colors = Shot(alpha_min=0.1), torch.rand(10, 1, 3, HEIGHT, WIDTH)
    for i, color in enumerate(colors, start=1):
        seen = history.update(still(color))
        torch.testing.assert_close(seen.color, colors[:i].mean(0))
        assert seen.length.unique().tolist() == [i]
        assert seen.reset == ("first frame" if i == 1 else "")
    # From here on the window is exponential: one tenth of the frame, nine tenths of the history.
    color = torch.rand(1, 3, HEIGHT, WIDTH)
    torch.testing.assert_close(history.update(still(color)).color, 0.1 * color + 0.9 * colors.mean(0))


def test_images_that_are_accumulated_as_well_have_the_weights_of_the_color() -> None:
    """A linear map: an image that is a multiple of the color stays one, in a history of its own."""
    watching = Watching()
    model, state = Accumulated(watching, lag_threshold=math.inf, firefly_limit=math.inf, also=("sun",)), None
    for seed in range(3):
        frame = whole_frame(model, 24, 40, seed=seed)
        _, state = model(frame.replace(extra={"sun": 3 * frame.color, "other": frame.color}), state)
        seen = watching.frames[-1]
        torch.testing.assert_close(seen.extra["sun"], 3 * seen.color)
        assert torch.equal(seen.extra["other"], frame.color)
    assert not torch.equal(seen.color, frame.color)


@pytest.mark.parametrize("in_graph", [False, True])
def test_each_image_of_a_batch_is_a_shot_of_its_own(in_graph: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """One stands still, one moves, and one cuts to caustics."""
    if in_graph:
        monkeypatch.setattr("mcdenoise.models.accumulated.at_hand", lambda device: False)
        monkeypatch.setattr("mcdenoise.models._history.at_hand", lambda device: False)

    def images(model: Accumulated, shots: Sequence[Sequence[Frame]]) -> Tensor:
        state, found = None, []
        for each in zip(*shots, strict=True):
            buffers = {name: torch.cat([frame.buffer(name) for frame in each]) for name in each[0].buffers}
            output, state = model(Frame(**buffers), state)
            found.append(output.image)
        return torch.stack(found)

    def shot(step: float, *numbers: int) -> list[Frame]:
        return [Frame(torch.rand(1, 3, 128, 160), **leaning_wall(n, 160, 128, step)) for n in numbers]

    shots, model = [shot(0, 0, 1, 2, 3), shot(1, 0, 1, 2, 3), shot(1, 0, 1, 900, 901)], Accumulated(Mean())
    shots[2][2:] = [frame.replace(color=caustics(0.3).color) for frame in shots[2][2:]]
    together, alone = images(model, shots), torch.cat([images(model, [shot]) for shot in shots], 1)
    torch.testing.assert_close(together[:, 1:], alone[:, 1:])
    # Where nothing moved, no projection rounds the motion.
    assert torch.equal(together[:, 0], alone[:, 0])


def test_disoccluded_surfaces_start_a_history_without_a_cut() -> None:
    history = Shot()
    near, uncovered = constant(1, 2.0), constant(1, 2.0)
    uncovered[..., : WIDTH // 2] = 9.0
    history.update(still(constant(3), depth=near))
    seen = history.update(still(constant(3, 3.0), depth=uncovered))
    assert seen.reset == ""
    assert seen.length[0, 0, 0].tolist() == [1, 1, 1, 2, 2, 2]
    assert seen.color[0, 0, 0].tolist() == [3, 3, 3, 2, 2, 2]


def test_the_motion_of_the_renderer_is_followed() -> None:
    history = Shot(lag_threshold=math.inf)
    columns = torch.arange(float(WIDTH)).expand(1, 3, HEIGHT, WIDTH)
    motion = torch.tensor([1.0, 0.0]).reshape(1, 2, 1, 1).expand(1, 2, HEIGHT, WIDTH)
    history.update(Frame(color=columns, motion=motion))
    seen = history.update(Frame(color=constant(3, 10.0), motion=motion))
    # Half of the new frame, and half of the old pixel on the right; the last column came into view.
    assert seen.color[0, 0, 0].tolist() == [5.5, 6.0, 6.5, 7.0, 7.5, 10.0]
    assert seen.length[0, 0, 0].tolist() == [2, 2, 2, 2, 2, 1]


@pytest.mark.parametrize("alpha_min", [0.1, 0.25])
def test_floor_and_sky_have_a_history_under_a_moving_camera(small_sequence: Path, alpha_min: float) -> None:
    sequence, history = open_sequence(small_sequence), Shot(alpha_min=alpha_min)
    for number in sequence.numbers:
        frame = sequence.frame(number)
        seen = history.update(frame)
        assert seen.reset == ("first frame" if number == 0 else "")
    floor = torch.isfinite(frame.depth) & (seen.length > 3)
    assert floor.float().mean() > 0.3
    accumulated = remodulate(seen.color, frame.albedo)
    raw, after = ((image - frame.reference).square() * floor for image in (frame.color, accumulated))
    # Four frames of independent noise: a quarter of the variance, and a little bias from resampling.
    assert after.sum() < 0.4 * raw.sum()
    sky = ~torch.isfinite(frame.depth)
    assert sky.float().mean() > 0.1
    assert (seen.length[sky] > 1).float().mean() > 0.8
    # The sky has no noise and one color, which blending must not change.
    torch.testing.assert_close(seen.color * sky, frame.color * sky)


def test_any_buffers_may_come_and_go() -> None:
    """A buffer that only one of two frames has is not compared."""
    size = (1, 3, HEIGHT, WIDTH)
    every: dict[str, Tensor] = {
        "normal": torch.rand(size),
        # This camera sees positions at this depth: its clip w.
        "depth": constant(1),
        "position": torch.rand(size),
        "motion": torch.zeros(1, 2, HEIGHT, WIDTH),
        "view_projection": torch.eye(4)[None],
    }
    subsets = [
        {name: value for bit, (name, value) in enumerate(every.items()) if choice >> bit & 1} for choice in range(32)
    ]
    color = torch.rand(2, *size)
    model = Accumulated(Watching())
    for first in subsets:
        _, state = model(Frame(color[0], **first))
        for second in subsets:
            output, _ = model(Frame(color[1], **second), state)
            length = model.inner.frames.pop().length
            assert torch.isfinite(output.image).all()
            if "motion" in second:
                assert length.unique().tolist() == [2]
            # Positions have a motion from the camera of the frame before.
            elif "position" not in second or "view_projection" not in first.keys() & second.keys():
                assert length.unique().tolist() == [1]
                assert torch.equal(output.image, model(Frame(color[1], **second))[0].image)
                model.inner.frames.pop()


@pytest.mark.parametrize("with_albedo", [True, False])
def test_a_firefly_does_not_survive(with_albedo: bool) -> None:
    history, albedo = Shot(alpha_min=0.1), 0.5 if with_albedo else 1.0
    buffers = {"albedo": constant(3, albedo, (9, 9))} if with_albedo else {}
    for number in range(4):
        color = constant(3, albedo, (9, 9))
        color[..., 4, 4] *= 1e4 if number == 0 else 1
        seen = history.update(still(color, **buffers))
        assert seen.color[..., 4, 4].unique().item() == pytest.approx(1 + 14 / (number + 1), rel=1e-5)
    seen.color[..., 4, 4] = 1
    torch.testing.assert_close(seen.color, constant(3, 1.0, (9, 9)))


def test_a_dark_texture_beside_a_bright_one_is_no_firefly() -> None:
    """The light is clamped: a white pixel among black ones, both lit alike, is as bright as its neighbours."""
    albedo = constant(3, 0.04, (9, 9))
    albedo[..., 4, 4] = 0.9
    seen = Shot().update(still(2 * albedo, albedo=albedo))
    torch.testing.assert_close(seen.color, constant(3, 2.0, (9, 9)))


def caustics(fraction: float) -> Frame:
    """Light 1, and in one pixel of 200 as much that all of these have ``fraction`` of it."""
    hit = torch.rand(1, 1, 128, 160, generator=torch.Generator().manual_seed(0)) < 1 / 200
    return still(torch.where(hit, 200 * fraction / (1 - fraction), 1.0).expand(1, 3, -1, -1))


@pytest.mark.parametrize(("fraction", "kept"), [(0.1, False), (0.3, True)])
def test_where_fireflies_are_much_of_the_light_they_are_caustics(fraction: float, kept: bool) -> None:
    frame, history = caustics(fraction), Shot()
    seen = history.update(frame)
    assert torch.equal(seen.current, frame.color) is kept
    # The limit holds for the whole shot, and no longer.
    assert torch.equal(history.update(caustics(0.1)).current, caustics(0.1).color) is kept
    history.reset()
    assert not torch.equal(history.update(caustics(0.1)).current, caustics(0.1).color)


@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_each_image_of_a_batch_and_each_shot_has_its_own_caustics(backend: Backend) -> None:
    """Every image is as if alone; at a cut, which is found by positions, the first frame of the next shot counts."""
    few, many = caustics(0.1), caustics(0.3)

    def shot(*images: Frame, x: float = 0.0) -> Frame:
        position = constant(3, 1.0, (128, 160)).repeat(len(images), 1, 1, 1) + x
        camera = torch.eye(4).repeat(len(images), 1, 1)
        return Frame(torch.cat([image.color for image in images]), position=position, view_projection=camera)

    history = Shot(backend=backend)
    seen = history.update(shot(few, many))
    for image, kept in ((few, False), (many, True)):
        alone = Shot(backend=backend).update(shot(image)).current
        assert torch.equal(alone, image.color) is kept
        torch.testing.assert_close(seen.current[int(kept)][None], alone, rtol=0, atol=0)
    seen = history.update(shot(many, few, x=1000.0))
    assert seen.reset == "cut"
    assert torch.equal(seen.current[0], many.color[0])
    assert not torch.equal(seen.current[1], few.color[0])
    torch.testing.assert_close(seen.color, seen.current, rtol=0, atol=0)


def test_who_names_a_limit_gets_it() -> None:
    frame = caustics(0.3)
    assert not torch.equal(Shot(firefly_limit=15).update(frame).current, frame.color)


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


def test_the_history_of_a_mirror_that_moves_is_short() -> None:
    history, last = Shot(), None
    for number, frame in enumerate(mirror_in_a_pan(2)):
        seen = history.update(frame)
        mirror = (frame.albedo == 0).all(1, keepdim=True)
        assert seen.length[mirror].unique().tolist() == [min(number + 1, 3)]
        if number > 2 and last is not None:
            expected = torch.lerp(frame.color, last.color.roll(-2, -1), 2 / 3)
            torch.testing.assert_close(seen.color * mirror, expected * mirror)
        last = seen


def test_diffuse_surfaces_keep_their_history_beside_a_mirror() -> None:
    """The mirror moves by its width: where it is now, the history was diffuse, and where it was, the present is."""
    history, everything_alike = Shot(), Shot(specular_length=math.inf)
    for number, frame in enumerate(mirror_in_a_pan(2)):
        seen, alike = history.update(frame), everything_alike.update(frame)
        diffuse = (frame.albedo > 0).all(1, keepdim=True)
        assert torch.equal(seen.length[diffuse], alike.length[diffuse])
        assert torch.equal(seen.color * diffuse, alike.color * diffuse)
        assert alike.length.max() == number + 1


def test_the_history_of_a_mirror_that_stands_still_grows() -> None:
    history, everything_alike = Shot(), Shot(specular_length=math.inf)
    for number, frame in enumerate(mirror_in_a_pan(0), start=1):
        # Less than what counts as motion.
        frame = frame.replace(motion=torch.full_like(frame.color[:, :2], 0.03))
        seen, alike = history.update(frame), everything_alike.update(frame)
        assert seen.length.max().item() == pytest.approx(number)
        assert torch.equal(seen.length, alike.length)
        assert torch.equal(seen.color, alike.color)


@pytest.mark.parametrize("alpha_min", [0.1, 0.4, 1.0])
@pytest.mark.parametrize("longest", [0, 1, 2.5, 20])
def test_a_shortened_history_is_that_of_a_shorter_history(alpha_min: float, longest: float) -> None:
    history, albedo = Shot(alpha_min=alpha_min, specular_length=longest), constant(3, 0.0)
    for _ in range(12):
        before = history.update(still(torch.rand(1, 3, HEIGHT, WIDTH), albedo=albedo))
    assert before.length.unique().tolist() == [12]
    color, motion = torch.rand(1, 3, HEIGHT, WIDTH), torch.full((1, 2, HEIGHT, WIDTH), 0.25)
    seen = history.update(Frame(color=color, albedo=albedo, motion=motion))
    length = before.length.clamp_max(longest)
    expected = accumulate(color, before.color, length, motion, alpha_min=alpha_min)
    torch.testing.assert_close(seen.color, expected[0])
    torch.testing.assert_close(seen.length, expected[1])
    # No history at all is not a cut: nothing says that the scene has changed.
    assert seen.reset == ""


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_mirror_of_unknown_motion_starts_anew(value: float) -> None:
    history, motion = Shot(), torch.zeros(1, 2, HEIGHT, WIDTH)
    motion[:, 0, 1, 1] = value
    for number in range(1, 6):
        color = torch.rand(1, 3, HEIGHT, WIDTH)
        seen = history.update(Frame(color=color, albedo=constant(3, 0.0), motion=motion))
        assert torch.equal(seen.color[..., 1, 1], color[..., 1, 1])
        assert seen.color.isfinite().all()
        assert seen.length[0, 0, 1, 1] == 1
        assert seen.length.max() == number


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


@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_a_lamp_does_not_bleed_into_the_ceiling_around_it(backend: Backend) -> None:
    """Same plane, no albedo: only their light tells one from the other."""
    history, without = Shot(backend=backend), Shot(lag_threshold=math.inf)
    for number in range(12):
        frame = seen_in_passing(number)
        offset = (frame.position[:, :2] - torch.tensor([34.0, 27.0]).reshape(1, 2, 1, 1)).abs()
        lamp = (offset[:, :1] < 9) & (offset[:, 1:] < 5)
        frame = frame.replace(color=torch.where(lamp, 40.0, frame.color))
        seen, bled = history.update(frame), without.update(frame)
        assert (seen.color * ~lamp).max() <= 1
        assert ((seen.color - 40) * lamp).abs().max() < 1e-3
    # This does not cost any of the history.
    assert seen.length[..., 12:-12, 12:-12].min() > 11.9
    assert (bled.color * ~lamp).max() > 5


@pytest.mark.parametrize("fraction", [0.1, 0.25, 0.5, 0.75])
def test_samples_of_one_brightness_are_no_lights(fraction: float) -> None:
    """One of a few small lights is drawn: beside each other there are often alike samples, and no light may be lost."""
    history, means = Shot(firefly_limit=math.inf), []
    for number in range(24):
        frame = seen_in_passing(number, (96, 128))
        lit = frame.color[:, :1] < fraction
        seen = history.update(frame.replace(color=torch.where(lit, 1.0, 0.02).expand_as(frame.color)))
        means.append(seen.color[..., 16:-16, 16:-16].mean().item())
    expected = fraction + 0.02 * (1 - fraction)
    assert sum(means[12:]) / 12 == pytest.approx(expected, rel=0.01)
    assert all(mean == pytest.approx(expected, rel=0.05) for mean in means)


def wall(color: Tensor, **buffers: Any) -> Frame:
    """A wall seen by the same camera in every frame; its positions are those of the pixels, with their rounding."""
    height, width = color.shape[-2:]
    rows, columns = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    camera = torch.diag(torch.tensor([1 / 1.7, 1 / 1.3, 1.0, 0.0]))
    camera[2, 3] = 1.0
    position = torch.stack([(2 * columns / width - 1) * 1.7, (2 * rows / height - 1) * 1.3, torch.ones_like(rows)])
    return Frame(color=color, **{"position": position[None] * 3, "view_projection": camera[None], **buffers})


@pytest.mark.parametrize("size", [(20, 30), (96, 110)])
def test_a_still_frame_needs_no_reprojection_to_the_last_bit(size: tuple[int, int]) -> None:
    """Whether that it is still is told by its motion, which is followed on demand, or by positions and cameras."""
    ordinary, short, by_positions = Shot(), Shot(), Shot()
    normal = constant(3, 0.6, size)
    albedo = constant(3, 0.5, size)
    albedo[..., : size[1] // 3] = 0
    for number in range(14):
        # A thing appears where there was a wall, without being told: its history is not the wall's.
        normal = normal.clone()
        normal[..., 5:9, number : number + 4] *= -1
        color = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(number))
        frame = wall(color, normal=normal, albedo=albedo)
        told = frame.replace(motion=torch.zeros(1, 2, *size))
        seen = ordinary.update(told, keep_all=True)
        for again in (short.update(told), by_positions.update(frame)):
            assert all(torch.equal(a, b) for a, b in zip(seen[:3], again[:3], strict=True))
            assert seen.reset == again.reset
        assert short.watching.frames[-1].hints.still is (number > 0)
    assert 1 in seen.length
    assert seen.length.max() == 14


CUTS = {
    "cut": {"normal": torch.tensor([0.0, 0.0, 1.0]).reshape(1, 3, 1, 1).expand(1, 3, HEIGHT, WIDTH)},
    "size change": {},
    "no motion, and no position with a previous camera": {"motion": None},
}


@pytest.mark.parametrize("reset", CUTS)
def test_the_method_inside_begins_anew_with_the_shot(reset: str) -> None:
    history = Shot()
    floor = torch.tensor([0.0, 1.0, 0.0]).reshape(1, 3, 1, 1).expand(1, 3, HEIGHT, WIDTH)
    for _ in range(3):
        history.update(still(constant(3), normal=floor))
    before, now, next_one = history.watching.states
    assert before is None
    assert (now["seen"].max(), next_one["seen"].max()) == (1, 2)
    size = (4, 4) if reset == "size change" else (HEIGHT, WIDTH)
    buffers = {"normal": None if size == (4, 4) else floor, **CUTS[reset]}
    frame = still(constant(3, 2.0, size), **buffers)
    seen = history.update(frame)
    assert (seen.reset, seen.length.unique().tolist(), seen.color.unique().tolist()) == (reset, [1], [2])
    assert history.watching.states[-1] is None
    # The next frame has a history, if it tells its motion.
    assert history.update(frame).length.unique().tolist() == [1 if frame.motion is None else 2]


@pytest.mark.parametrize("by_positions", [False, True])
@pytest.mark.parametrize("size", [(20, 30), (96, 110)])
def test_a_state_of_zeros_is_no_state(size: tuple[int, int], by_positions: bool) -> None:
    """A graph that takes a state can begin with zeros; so can the method inside."""
    model = Accumulated(Mean())
    colors = torch.rand(3, 2, 3, *size)

    def frame(color: Tensor) -> Frame:
        if not by_positions:
            return Frame(color, motion=torch.full((2, 2, *size), 0.4), depth=torch.ones(2, 1, *size))
        seen = wall(color[:1])
        buffers = {name: torch.cat([value, value]) for name, value in seen.items() if name != "color"}
        return Frame(color, **buffers)

    expected, state = model(frame(colors[0]))
    zeros = pytree.tree_map_only(Tensor, torch.zeros_like, model(frame(colors[1]), state)[1])
    found, again = model(frame(colors[0]), zeros)
    assert torch.equal(found.image, expected.image)
    assert pytree.tree_structure(again) == pytree.tree_structure(state)
    for one, other in zip(pytree.tree_leaves(again), pytree.tree_leaves(state), strict=True):
        assert one is other or torch.equal(one, other)


def test_buffers_that_accumulation_provides_are_not_needed_of_a_frame() -> None:
    class Wanting(Watching):
        needs = dataclasses.replace(Watching.needs, buffers=frozenset({"color", "current", "length", "roughness"}))

    assert Accumulated(Wanting()).needs.buffers == {"color", "roughness"}
    # The result of a history depends on the whole image: whether there was a cut.
    assert Accumulated(Wanting()).needs.reach is None


def switched(count: int, level: float) -> list[Frame]:
    """Noisy light that falls to ``level`` after 20 frames; nothing moves."""
    g, frames = torch.Generator().manual_seed(0), []
    for number in range(count):
        noise = -torch.log(torch.rand(1, 3, 16, 16, generator=g).clamp_min(1e-6))
        frames.append(still(noise if number < 20 else level * noise))
    return frames


@pytest.mark.parametrize("level", [0.0, 0.1])
def test_the_history_is_given_up_where_the_light_changes(level: float) -> None:
    lagging, history = Shot(lag_threshold=math.inf), Shot()
    for frame in switched(21, level):
        ghost, seen = lagging.update(frame), history.update(frame)
    # A tenth of the new light, nine of the old; and nothing but the new one.
    assert abs(ghost.color.mean() - (0.1 * level + 0.9)) < 0.1
    torch.testing.assert_close(seen.color, frame.color, rtol=0.2, atol=0.05 * level)
    assert seen.length.max() <= 4
    assert seen.reset == ""


def test_brighter_light_comes_sooner() -> None:
    """The brighter it is, the more noise there is to hide the change: some frames are needed."""
    lagging, history = Shot(lag_threshold=math.inf), Shot()
    for frame in switched(24, 5.0):
        expected, seen = lagging.update(frame), history.update(frame)
    assert expected.color.mean() < 2.5
    assert seen.color.mean() > 4


def test_after_a_change_a_new_history_grows() -> None:
    history = Shot()
    for frame in switched(30, 0.2):
        seen = history.update(frame)
    assert seen.length.min() > 9
    assert abs(seen.color.mean() - 0.2) < 0.02


def test_a_first_frame_a_cut_and_another_size_begin_a_recent_history_too() -> None:
    history, fresh = Shot(), Shot()
    floor = torch.tensor([0.0, 1.0, 0.0]).reshape(1, 3, 1, 1).expand(1, 3, HEIGHT, WIDTH)
    for frame in (still(constant(3, 9.0, (4, 4))), still(constant(3, 5.0), normal=floor.roll(1, 1))):
        history.update(frame)
    for value in (1.0, 2.0, 3.0):
        frame = still(constant(3, value), normal=floor)
        seen, expected = history.update(frame), fresh.update(frame)
        assert torch.equal(seen.color, expected.color)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_frames_are_accumulated_in_float32(dtype: torch.dtype) -> None:
    history, twin = (Shot(alpha_min=1e-6, lag_threshold=math.inf) for _ in range(2))
    for color in torch.rand(300, 1, 3, 4, 4, generator=torch.Generator().manual_seed(0)).to(dtype):
        seen, expected = history.update(still(color)), twin.update(still(color.float()))
    assert seen.color.dtype == seen.length.dtype == torch.float32
    assert torch.equal(seen.color, expected.color)
    # More than bfloat16 can count.
    assert seen.length.unique().tolist() == [300]


def test_the_method_inside_is_told_that_nothing_moves() -> None:
    """By the motion of the frame, which goes before its positions, or by camera and positions."""
    frame, motion = wall(torch.rand(1, 3, 20, 30)), torch.zeros(1, 2, 20, 30)
    tiny, moved = motion.clone(), frame.position.clone()
    tiny[0, 1, 13, 17], moved[0, 2, 13, 17] = 1e-6, moved[0, 2, 13, 17] + 1e-3
    for second, expected in (
        (frame, True),
        (frame.replace(previous_position=frame.position), True),
        (frame.replace(previous_position=moved), False),
        (frame.replace(view_projection=frame.view_projection * 1.0001), False),
        (frame.replace(motion=motion), True),
        (frame.replace(motion=tiny), False),
        (frame.replace(motion=motion, previous_position=moved), True),
        (still(frame.color), True),
        (still(frame.color, motion=tiny), False),
        (Frame(frame.color), False),
    ):
        shot = Shot()
        for each in (frame, second):
            shot.update(each)
        assert [seen.hints.still for seen in shot.watching.frames] == [False, expected]


def before_a_camera(z: float, previous: float = 0) -> Frame:
    """A wall at this depth; the camera stands still."""
    matrix = torch.eye(4)[None]
    matrix[:, 2, 3], matrix[:, 3, 3] = 1, 0  # clip w = z
    y, x = torch.meshgrid((torch.arange(10) + 0.5) / 5 - 1, (torch.arange(10) + 0.5) / 5 - 1, indexing="ij")
    position = torch.stack([x * z, y * z, torch.full_like(x, z)])[None]
    known = position.clone()
    known[:, 2] = previous
    normal = torch.tensor([0.0, 0.0, -1.0]).reshape(1, 3, 1, 1).expand_as(position)
    buffers = {"position": position, "previous_position": known if previous else None, "view_projection": matrix}
    return Frame(torch.ones(1, 3, 10, 10), normal=normal, **buffers)


def test_moving_surfaces_keep_their_history_and_others_have_none() -> None:
    """A wall comes closer, by more than the limit for positions; depth is what the camera sees of these."""
    for second, reset in ((before_a_camera(1.8, 2.0), ""), (before_a_camera(1.8), "cut"), (before_a_camera(2.0), "")):
        history = Shot()
        history.update(before_a_camera(2.0, 2.0))
        seen = history.update(second)
        assert seen.reset == reset
        assert seen.length.unique().tolist() == [1 if reset else 2]


@pytest.mark.parametrize("name", ["position", "previous_position"])
def test_motion_goes_before_positions(name: str) -> None:
    """Seen from this camera, every position is out of view."""
    history, buffers = Shot(), {name: constant(3, 100.0), "view_projection": torch.eye(4)[None]}
    history.update(still(constant(3), **buffers))
    assert history.update(still(constant(3), **buffers)).length.unique().tolist() == [2]
