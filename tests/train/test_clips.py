"""Clips: what is drawn is the shot, flipped, turned and lit otherwise, and nothing depends on who draws it."""

import torch
from torch import Tensor

from mcdenoise.ops import motion_from_position
from mcdenoise.train.clips import Clip, ClipSampler
from mcdenoise.train.config import TrainConfig
from mcdenoise.train.front import ACCUMULATED
from mcdenoise.train.shots import Shot

PARTS = {**ACCUMULATED, "albedo": 3, "normal": 3, "depth": 1, "reference": 3}


def shot_of(stack: Tensor) -> Shot:
    parts = stack.split(list(PARTS.values()), 1)
    return in_memory(dict(zip(PARTS, parts, strict=True)), demodulated=True)


def in_memory(buffers: dict[str, Tensor], *, demodulated: bool = False) -> Shot:
    arrays, (frames, _, *size) = {name: buffer.numpy() for name, buffer in buffers.items()}, buffers["color"].shape
    return Shot((lambda: arrays,), range(frames), (size[0], size[1]), demodulated=demodulated)


def clip_of(stack: Tensor) -> Clip:
    return Clip(dict(zip(PARTS, stack.split(list(PARTS.values()), 2), strict=True)))


def numbered(length: int = 3) -> Tensor:
    """A shot in which every value is another whole number: channel, frame, row and column can be read off."""
    count = length * sum(PARTS.values()) * 6 * 7
    return torch.arange(1.0, count + 1).reshape(length, -1, 6, 7)


def orbit(clip: Tensor) -> list[Tensor]:
    turned = [clip.rot90(k, (-2, -1)) for k in range(4)]
    return [*turned, *(t.flip(-1) for t in turned)]


def test_clips_are_the_shot_turned_and_renamed() -> None:
    crop, frames = 4, 2
    shot = numbered()
    # Infinite depths must neither vanish nor spread.
    shot[:, 13, 2, 3] = torch.inf
    windows = {
        (start, top, left): shot[start : start + frames, :, top : top + crop, left : left + crop]
        for start in range(2)
        for top in range(3)
        for left in range(4)
    }
    candidates = [
        (place, orientation, clip_of(turned[None]))
        for place, window in windows.items()
        for orientation, turned in enumerate(orbit(window))
    ]
    sampler = ClipSampler([shot_of(shot)], TrainConfig(frames=frames, crop=crop))
    places, orientations, orders = set(), set(), set()
    for seed in range(96):
        drawn = sampler.draw([seed])
        found = [(p, o, source) for p, o, source in candidates if torch.equal(source["depth"], drawn["depth"])]
        assert len(found) == 1
        place, orientation, source = found[0]
        # One order of the colour channels for radiance, albedo and reference.
        order = [int((source["color"][0, 0, :, 0, 0] == value).nonzero()) for value in drawn["color"][0, 0, :, 0, 0]]
        for name in ("color", "albedo", "reference"):
            assert torch.equal(drawn[name], source[name][:, :, order]), name
        # Normals: the world's axes renamed and reversed, the same for all pixels and frames.
        axes = [
            int((source["normal"][0, 0, :, 0, 0] == value.abs()).nonzero()) for value in drawn["normal"][0, 0, :, 0, 0]
        ]
        signs = drawn["normal"][0, 0, :, 0, 0].sign().reshape(1, 1, 3, 1, 1)
        assert sorted(axes) == [0, 1, 2]
        assert torch.equal(drawn["normal"], source["normal"][:, :, axes] * signs)
        places.add(place)
        orientations.add(orientation)
        orders.add(tuple(order))
    assert orientations == set(range(8))
    assert len(orders) == 6
    assert {start for start, _, _ in places} == {0, 1}
    assert {top for _, top, _ in places} == {0, 1, 2}
    assert {left for _, _, left in places} == {0, 1, 2, 3}


def test_a_clip_depends_on_its_seed_alone() -> None:
    sampler = ClipSampler(
        [shot_of(numbered()), shot_of(numbered(4))], TrainConfig(frames=2, crop=4, lamps=0.5, exposure=1.0, tint=1.0)
    )
    torch.manual_seed(1)
    before = torch.random.get_rng_state()
    batch = sampler.draw([7, 8, 9])
    # The global random generator is not changed.
    assert torch.equal(torch.random.get_rng_state(), before)
    assert batch["color"].shape == (3, 2, 3, 4, 4)
    torch.manual_seed(2)
    for i, seed in ((2, 9), (0, 7)):
        alone = sampler.draw([seed])
        assert all(torch.equal(alone[name][0], batch[name][i]) for name in PARTS)
    assert not torch.equal(batch["color"][0], batch["color"][1])


def test_exposure_scales_light_and_nothing_else() -> None:
    """Light is linear: noisy color and reference of a clip grow by one factor, within the limit."""
    stack = numbered()
    seeds = list(range(40))
    plain = ClipSampler([shot_of(stack)], TrainConfig(frames=2, crop=4)).draw(seeds)
    lit = ClipSampler([shot_of(stack)], TrainConfig(frames=2, crop=4, exposure=2.0)).draw(seeds)
    for name in ("length", "albedo", "normal", "depth"):
        assert torch.equal(lit[name], plain[name]), name
    factors = (lit["color"] / plain["color"])[:, :1, :1, :1, :1]
    torch.testing.assert_close(lit["color"], plain["color"] * factors)
    torch.testing.assert_close(lit["current"], plain["current"] * factors)
    torch.testing.assert_close(lit["reference"], plain["reference"] * factors)
    stops = factors.log2()
    assert stops.abs().max() <= 2
    assert stops.min() < -1
    assert stops.max() > 1


def test_motion_is_flipped_and_turned_with_the_image() -> None:
    """Every pixel of a frame has a number; its motion says where that number was in the frame before, in any view."""
    size = 9
    rows, columns = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    # Another motion for every pixel, in whole pixels, inside the image.
    steps = torch.randint(-3, 4, (2, size, size))
    x, y = (columns + steps[0]).clamp(0, size - 1), (rows + steps[1]).clamp(0, size - 1)
    before = torch.arange(float(size * size)).reshape(size, size)
    depth = torch.stack([before, before[y, x]])[:, None]
    motion = torch.stack([torch.zeros(2, size, size), torch.stack([x - columns, y - rows]).float()])
    motion[1, :, 4, 4] = torch.inf
    features = {"motion": motion, "depth": depth, "reference": torch.ones(2, 3, size, size)}
    features["color"] = features["reference"]
    clip = ClipSampler([in_memory(features)], TrainConfig(frames=2, crop=size)).draw(list(range(40)))
    views = {tuple(view[0, 0].flatten().tolist()) for view in clip["depth"]}
    assert len(views) == 8
    for numbers, vectors in zip(clip["depth"][:, :, 0], clip["motion"][:, 1], strict=True):
        known = vectors.isfinite().all(0)
        assert int((~known).sum()) == 1
        # Still unknown, not NaN.
        assert vectors[:, ~known].abs().isinf().all()
        there = torch.where(known, vectors, 0).long() + torch.stack([columns, rows])
        assert torch.equal(numbers[0][there[1], there[0]][known], numbers[1][known])


def test_the_camera_sees_the_crop_as_the_motion_has_it() -> None:
    """Positions seen from the previous camera of a clip are where its motion says, in pixels of the crop."""
    height, width, crop = 18, 25, 8
    torch.manual_seed(0)
    view = torch.tensor([[1.1, 0.2, 0.1, 0.1], [-0.1, 1.3, 0.0, -0.2], [0.1, 0.1, 1.0, 1.0], [0.2, 0.3, 0.1, 1.5]])
    views = torch.stack([view + 0.01 * t for t in range(3)])
    position = 2 * torch.rand(3, 3, height, width) - 1
    motion = torch.stack([motion_from_position(position[t : t + 1], views[max(t - 1, 0)][None])[0] for t in range(3)])
    features = {"position": position, "motion": motion, "view_projection": views}
    features["color"] = features["reference"] = torch.ones(3, 3, height, width)
    clip = ClipSampler([in_memory(features)], TrainConfig(frames=3, crop=crop)).draw(list(range(40)))
    found = motion_from_position(clip["position"][:, 1].contiguous(), clip["view_projection"][:, 0].contiguous())
    # Pixel coordinates of some 100, of which float32 knows 1e-5; measured: 2e-5.
    torch.testing.assert_close(found, clip["motion"][:, 1], rtol=1e-4, atol=2e-4)
