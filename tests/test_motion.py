"""Wrong motion is told while it is streamed, with the likely mistake; right motion never is."""

import warnings
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from reads import without_reads
from torch import Tensor, nn

from mcdenoise import Denoiser, Frame, create_model
from mcdenoise.models import Accumulated
from mcdenoise.motion import doubt_motion, seen_in

HEIGHT, WIDTH, FRAMES = 72, 96, 3


def shot(
    *, speed: tuple[float, float] = (0.12, 0.05), noise: float = 0.3, sky: bool = False, ball: float = 0.0
) -> Iterator[Frame]:
    """A leaning wall with a pattern, seen by a camera that moves; perhaps with a sky, and a square that moves."""
    g = torch.Generator().manual_seed(0)
    texture = torch.rand(1, 3, 32, 32, generator=g)
    rows, columns = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    rays = torch.stack([columns / WIDTH * 2 - 1, (rows / HEIGHT * 2 - 1) * HEIGHT / WIDTH, torch.ones(HEIGHT, WIDTH)])
    matrices, behind = [], rows < HEIGHT / 3 if sky else torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    for number in range(FRAMES):
        eye = torch.tensor([speed[0], speed[1], 0.0]) * number
        depth = 3 / (1 + 0.2 * rays[0])
        in_front = ((columns - 30 - ball * number).abs() < 12) & ((rows - 40).abs() < 12)
        depth = torch.where(in_front, 1.5, depth)
        position = eye[:, None, None] + rays * depth
        places = torch.where(in_front, torch.stack([columns - ball * number, rows]) / 12, position[:2] * 0.6)
        places = places.permute(1, 2, 0)[None] % 2 - 1
        albedo = nn.functional.grid_sample(texture, places, align_corners=False)
        albedo = (albedo + noise * (torch.rand(albedo.shape, generator=g) - 0.5)).clamp(0, 1)
        matrix = torch.zeros(4, 4)
        matrix[0, 0], matrix[1, 1], matrix[2, 2], matrix[2, 3] = 1, WIDTH / HEIGHT, 1, 1
        matrix[3] = -(torch.cat([eye, torch.zeros(1)]) @ matrix)
        matrix[3, 2] -= 0.1
        matrices.append(matrix)
        earlier = torch.cat([position, torch.ones(1, HEIGHT, WIDTH)]).permute(1, 2, 0) @ matrices[max(number - 1, 0)]
        earlier = (earlier[..., :2] / earlier[..., 3:] + 1) / 2 * torch.tensor([WIDTH, HEIGHT])
        motion = earlier.permute(2, 0, 1) - torch.stack([columns, rows])
        motion = torch.where(in_front, torch.tensor([-ball if number else 0.0, 0.0])[:, None, None], motion)
        motion, depth = torch.where(behind, torch.inf, motion), torch.where(behind, torch.inf, depth)
        light = torch.rand(1, 3, HEIGHT, WIDTH, generator=g) ** 4 * 5
        yield Frame(
            color=light * albedo,
            albedo=albedo,
            depth=depth[None, None],
            position=torch.where(behind, 0.0, position)[None],
            motion=motion[None],
            view_projection=matrix[None],
        )


def told(frames: list[Frame]) -> list[str]:
    seen = [seen_in(frame) for frame in frames]
    return list(map(doubt_motion, frames, seen, [None, *seen[:-1]]))


def warned(frames: list[Frame], **arguments: Any) -> list[str]:
    denoiser = Denoiser(Accumulated(create_model("noisy")), **arguments)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        for frame in frames:
            denoiser(frame)
    return [str(each.message) for each in found]


def by_motion(frame: Frame) -> Frame:
    return frame.replace(position=None, view_projection=None)


def by_cameras(frame: Frame) -> Frame:
    return frame.replace(motion=None)


RIGHT: dict[str, dict[str, Any]] = {
    "moving": {},
    "one axis": {"speed": (0.1, 0.0)},
    "slow": {"speed": (0.005, 0.003)},
    "fast": {"speed": (0.9, 0.2)},
    "still": {"speed": (0.0, 0.0)},
    "an object moves": {"speed": (0.0, 0.0), "ball": 5.0},
    "noisier than the texture": {"noise": 3.0},
    "clean": {"noise": 0.0},
    "sky": {"sky": True},
}


def test_a_camera_that_no_other_reading_fits_is_read_without_a_warning() -> None:
    """Read as its transpose, it projects all points to infinity."""
    frame = next(shot())
    frame.view_projection[..., 3, 2] = 0
    assert told([frame]) == [""]


@pytest.mark.parametrize("scene", RIGHT)
@pytest.mark.parametrize(
    ("ways", "without"), [(by_motion, ("albedo",)), (by_cameras, ())], ids=["motion, color", "cameras, features"]
)
def test_right_motion_is_never_doubted(scene: str, ways: Callable[[Frame], Frame], without: tuple[str, ...]) -> None:
    if "ball" in RIGHT[scene] and ways is by_cameras:
        pytest.skip("cameras alone do not tell the motion of an object")
    assert told([ways(frame).replace(**dict.fromkeys(without)) for frame in shot(**RIGHT[scene])]) == [""] * FRAMES


def scaled(x: float, y: float) -> Callable[[Tensor], Tensor]:
    return lambda motion: motion * torch.tensor([x, y]).reshape(1, 2, 1, 1)


MISTAKES: dict[str, tuple[Callable[[Tensor], Tensor], str]] = {
    "sign": (scaled(-1, -1), "current - previous, y down, pixels"),
    "axes": (lambda motion: motion.flip(1), "x and y swapped, previous - current, y down"),
    "y up": (scaled(1, -1), "y up"),
    "unit": (scaled(1 / WIDTH, 1 / HEIGHT), "parts of the image"),
    "clip space": (scaled(2 / WIDTH, 2 / HEIGHT), "parts of half the image"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
@pytest.mark.parametrize("sky", [False, True], ids=["", "sky"])
def test_the_likely_mistake_of_motion_is_told(mistake: str, sky: bool) -> None:
    change, expected = MISTAKES[mistake]
    frames = [
        by_motion(frame.replace(motion=change(frame.motion))) for frame in shot(sky=sky) if frame.motion is not None
    ]
    for message in told(frames)[1:]:
        assert "worse than no motion" in message
        assert expected in message


def test_a_denoiser_warns_once_where_values_are_at_hand() -> None:
    frames = [by_motion(frame.replace(motion=-frame.motion)) for frame in shot() if frame.motion is not None]
    (message,) = warned(frames)
    assert "worse than no motion" in message
    # Other arguments do not hide it; a GPU would have to be waited for, and a single frame has no motion.
    assert len(warned(frames, differentiable=True)) == 1
    with without_reads():
        assert warned(frames) == []


@pytest.mark.parametrize(
    ("change", "word"), [(lambda m: m.mT, "transposed"), (lambda m: m * torch.tensor([1, -1, 1, 1.0]), "y up")]
)
def test_the_likely_mistake_of_a_camera_is_told(change: Callable[[Tensor], Tensor], word: str) -> None:
    wrong: list[Any] = [by_cameras(frame) for frame in shot()]
    wrong = [each.replace(view_projection=change(each.view_projection)) for each in wrong]
    for message in told(wrong):
        assert "worse than no motion" in message
        assert word in message


@pytest.mark.parametrize("moves", [0.3, 40.0])
def test_noise_alone_tells_nothing_of_motion(moves: float) -> None:
    """Interpolated noise is less unlike any noise, so that another reading of the motion seems better."""
    frames = [
        Frame(*torch.rand(2, 1, 3, 48, 64), normal=torch.rand(1, 3, 48, 64), motion=moves * torch.randn(1, 2, 48, 64))
        for _ in range(2)
    ]
    assert doubt_motion(frames[1], seen_in(frames[1]), seen_in(frames[0])) == ""


def test_what_is_not_used_is_not_doubted() -> None:
    frames = [by_motion(frame.replace(motion=-frame.motion)) for frame in shot() if frame.motion is not None]
    denoiser = Denoiser("noisy")
    for frame in frames:
        denoiser(frame)
    # The frame before was refused: the next one is compared with the one before that.
    good = [by_motion(frame) for frame in shot()]
    denoiser = Denoiser(Accumulated(create_model("noisy")))
    denoiser(good[0])
    with pytest.raises(Exception, match="depth"):
        denoiser(good[1].replace(depth=torch.full((1, 1, HEIGHT, WIDTH), torch.nan)))
    denoiser(good[1])
