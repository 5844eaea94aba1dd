"""The fast backend of a shot's history against the reference implementation."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from reference_cases import slice_of_pixels, transposed
from torch import Tensor
from toys import Seen, Shot

from mcdenoise.frame import Frame
from mcdenoise.ops import Surface, use
from mcdenoise.ops._history import COLOR, SQUARE, light_changes
from mcdenoise.ops._numba import _runtime
from mcdenoise.ops._steps import history as steps

pytestmark = pytest.mark.usefixtures("nan_in_fresh_memory")
SIZE = (37, 23)
FRAMES = 9


def camera(shift: float) -> Tensor:
    """Looks along z from ``x = shift``."""
    matrix = torch.zeros(1, 4, 4, dtype=torch.float64)
    matrix[0, 0, 0], matrix[0, 1, 1], matrix[0, 2, 2], matrix[0, 2, 3], matrix[0, 3, 0] = 1, 1, 1, 1, -shift
    return matrix


def shot(*without: str, size: tuple[int, int] = SIZE, batch: int = 1, speed: float = 0.07) -> list[Frame]:
    """A rough wall with a lamp before a sky, partly without albedo, seen in passing; left the light goes down."""
    g = torch.Generator().manual_seed(0)
    height, width = size
    rows, columns = torch.meshgrid(
        (torch.arange(height) + 0.5) / height * 2 - 1, (torch.arange(width) + 0.5) / width * 2 - 1, indexing="ij"
    )

    def draw(channels: int) -> Tensor:
        return torch.rand(batch, channels, height, width, generator=g, dtype=torch.float64)

    frames, rough = [], 0.02 * draw(1)
    for number in range(FRAMES):
        x, light = number * speed, torch.where(columns > 0, 1.0, 1.0 if number < 6 else 0.2)
        depth = 2 + 0.1 * torch.sin(7 * (columns * 2 + x)) + rough
        position = torch.cat([depth * columns + x, depth * rows, depth], 1)
        noise = -torch.log(draw(3).clamp_min(1e-6)) * torch.where(draw(1) < 0.01, 500, 1)
        sky = (rows < -0.7).expand_as(depth)
        lamp = ((position[:, :1] - 0.6).abs() < 0.4) & (rows.abs() < 0.3)
        buffers = {
            "albedo": torch.where(lamp, 0.5, (0.1 + 0.9 * draw(3)) * (draw(1) > 0.2)),
            "normal": torch.nn.functional.normalize(draw(3) * 0.4 + torch.tensor([0.0, 0, -1]).reshape(1, 3, 1, 1)),
            "depth": torch.where(sky, torch.inf, depth),
            "position": torch.where(sky, 0, position),
            "previous_position": torch.where(sky, 0, position) + 1e-3,
            "motion": 2 * draw(2) - 1,
            "view_projection": camera(x).expand(batch, 4, 4),
        }
        color = torch.where(lamp, 300.0, light * noise)
        given = {name: value.double() for name, value in buffers.items() if name not in without}
        frames.append(Frame(color.double(), **given))
    return frames


def passed(frames: list[Frame], backend: Any, alpha_min: float = 0.1) -> list[Seen]:
    history = Shot(backend, alpha_min=alpha_min, firefly_limit=15.0)
    return [history.update(frame) for frame in frames]


def assert_same(found: list[Seen], expected: list[Seen], tolerance: float) -> None:
    for a, b in zip(found, expected, strict=True):
        assert a.reset == b.reset
        assert a.history == pytest.approx(b.history)
        for image, plain in zip(a[:3], b[:3], strict=True):
            assert image.dtype == plain.dtype
            torch.testing.assert_close(image, plain, rtol=tolerance, atol=tolerance * plain.abs().mean().item())


WAYS = {
    "nothing": shot("motion", "previous_position", speed=0.0),
    "motion": shot("previous_position"),
    "positions": shot("motion", "previous_position"),
    "previous positions": shot("motion"),
    # A neighbour would lie too far off.
    "without normals": shot("motion", "previous_position", "normal", speed=0.02),
    "without albedo": shot("motion", "albedo"),
    "without depth": shot("motion", "depth"),
    "color and motion alone": shot("albedo", "normal", "depth", "position", "previous_position"),
    "two images": shot("previous_position", batch=2),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("alpha_min", [0.1, 0.4])
def test_the_history_is_that_of_the_reference(way: str, alpha_min: float) -> None:
    expected = passed(WAYS[way], "torch", alpha_min=alpha_min)
    assert expected[5].length.max() > 3
    assert_same(passed(WAYS[way], "numba", alpha_min=alpha_min), expected, 1e-9)


@pytest.mark.parametrize("size", [(1, 1), (8, 1), (6, 300)], ids=str)
def test_sizes(size: tuple[int, int]) -> None:
    frames = shot("previous_position", size=size)
    assert_same(passed(frames, "numba"), passed(frames, "torch"), 1e-9)


@pytest.mark.parametrize("layout", [slice_of_pixels, transposed])
def test_layout_in_memory_and_threads_change_nothing(
    layout: Callable[[Tensor], Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_runtime, "PIXELS_A_THREAD", 1)
    expected = passed(WAYS["two images"], "numba")
    laid_out = [frame.map(lambda image: layout(image) if image.ndim == 4 else image) for frame in WAYS["two images"]]
    for count in (1, 2, 5):
        torch.set_num_threads(count)
        for a, b in zip(passed(laid_out, "numba"), expected, strict=True):
            assert all(map(torch.equal, a[:3], b[:3]))


def test_the_fraction_with_a_history_is_that_of_each_image() -> None:
    first, second = WAYS["two images"][:2]
    surfaces = [Surface(frame.position, frame.normal, frame.depth) for frame in (second, first)]
    motion = torch.zeros_like(second.color[:, :2])
    motion[1, ..., : SIZE[1] // 2] = torch.inf
    found = []
    for backend in ("torch", "numba"):
        with use(backend):
            before, entering = (steps.incoming(frame.color, 15.0, compared=False) for frame in (first, second))
            history = steps.without_history(before), torch.ones_like(before[:, :1])
            settings = {"albedo": second.albedo, "specular_length": 2, "lag_threshold": math.inf}
            found.append(steps.blend(entering, *history, motion, *surfaces, alpha_min=0.1, **settings)[2])
    torch.testing.assert_close(found[1], found[0], check_dtype=False)
    assert found[0][1] < found[0][0] - 0.2


@pytest.mark.parametrize("root", [0.9, 1.0, 1.02, 1.2, 3.0])
def test_the_change_of_the_light_is_a_james_stein_estimate(root: float) -> None:
    size, variance, length = (1, 1, 80, 90), 0.1, 5.0
    history = torch.ones(1, 9, 80, 90, dtype=torch.float64)
    history[:, SQUARE] += variance * (length - 1) / length
    lengths = torch.full(size, length, dtype=torch.float64)
    factors = light_changes(history, lengths, torch.full(size, root, dtype=torch.float64))
    change, powers = root - 1, torch.tensor([4, 4, 4, 1, 2, 4, 4, 4, 1], dtype=torch.float64)
    # In the middle, and in corners, where windows have 2x2 blocks, or 32x(16 + 10) pixels.
    for y, x, pixels in ((40, 40, 48 * 48), (0, 0, 32 * 32), (0, 89, 32 * 26)):
        kept = max(1 - 8 * variance / (pixels * change**2), 0) if change else 0
        one = min(max(1 + kept * change, 0.7), 1.4)
        torch.testing.assert_close(factors[0, :, y, x], one**powers, rtol=1e-12, atol=1e-12)
    assert light_changes(history, torch.ones_like(lengths), 1.1 * torch.ones_like(lengths)).eq(1).all()


@pytest.mark.parametrize("light", [1.0, 0.8, 1.25])
def test_a_history_follows_a_change_of_the_light_that_noise_hides(light: float) -> None:
    generator = torch.Generator().manual_seed(0)
    history, length = torch.empty(0), torch.empty(0)
    for number in range(17):
        noise = -torch.rand(1, 3, 96, 96, generator=generator).clamp_min(1e-6).log()
        entering = steps.incoming(noise * (light if number == 16 else 1))
        if number:
            history, length, _ = steps.blend(entering, history, length, None, alpha_min=0.03, lag_threshold=2.0)
        else:
            history, length = steps.without_history(entering), torch.ones_like(entering[:, :1])
    # A mean of 17 frames would follow a seventeenth of the way.
    assert abs(float(history[:, COLOR].mean()) / light - 1) < 0.03
