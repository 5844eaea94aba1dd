"""The fast backend of a shot's history against the reference implementation."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import pytest
import torch
from reference_cases import by, channels_last, every_other_column, slice_of_pixels, transposed
from torch import Tensor

from mcdenoise.ops import Surface, clamp_fireflies, demodulate, motion_from_position, use
from mcdenoise.ops._numba import _runtime
from mcdenoise.ops._steps import history as steps

SIZE = (37, 23)
FRAMES = 9
BMFR = {"alpha_min": 0.2, "rule": "bmfr", "position_limit": 0.01, "normal_limit": 0.3}


class Picture(NamedTuple):
    color: Tensor
    albedo: Tensor | None = None
    normal: Tensor | None = None
    depth: Tensor | None = None
    position: Tensor | None = None
    previous_position: Tensor | None = None
    motion: Tensor | None = None
    view_projection: Tensor | None = None


class Past(NamedTuple):
    color: Tensor
    current: Tensor
    length: Tensor
    kept: Tensor


@pytest.fixture(autouse=True)
def nan_in_fresh_memory() -> Iterator[None]:
    """Fills what is left to be written with NaN, so that what was forgotten shows."""
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)


def camera(shift: float) -> Tensor:
    """Looks along z from ``x = shift``."""
    matrix = torch.zeros(1, 4, 4, dtype=torch.float64)
    matrix[0, 0, 0], matrix[0, 1, 1], matrix[0, 2, 2], matrix[0, 2, 3], matrix[0, 3, 0] = 1, 1, 1, 1, -shift
    return matrix


def shot(
    *without: str, size: tuple[int, int] = SIZE, batch: int = 1, speed: float = 0.07, dtype: torch.dtype = torch.float64
) -> list[Picture]:
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
        given = {name: value.to(dtype) for name, value in buffers.items() if name not in without}
        frames.append(Picture(color.to(dtype), **given))
    return frames


def passed(
    frames: list[Picture],
    backend: Any,
    rule: dict[str, Any] | None = None,
    *,
    limit: float = 15.0,
    window: int = 7,
    specular_length: float = 2,
    lag_threshold: float = 2.0,
    still: bool = False,
) -> list[Past]:
    """Every frame of a shot with its past."""
    results: list[Past] = []
    before, history, length = Surface(), torch.empty(0), torch.empty(0)
    tests = lag_threshold < math.inf
    for number, frame in enumerate(frames):
        position = frame.position
        # The camera looks along z.
        depth = position[:, 2:] if frame.depth is None and position is not None else frame.depth
        with use(backend):
            entering = steps.incoming(frame.color, frame.albedo, limit, window, compared=tests)
            seen = steps.lights(entering[:, steps.MEAN]) if tests else None
            if number == 0:
                history, length = steps.without_history(entering), torch.ones_like(entering[:, :1])
                kept = torch.zeros(len(length))
            else:
                motion = frame.motion
                past = position if frame.previous_position is None or position is None else frame.previous_position
                if motion is None and past is not None and not still:
                    camera = frames[number - 1].view_projection
                    assert camera is not None
                    motion = motion_from_position(past, camera)
                history, length, kept = steps.blend(
                    *(entering, history, length, motion, Surface(past, frame.normal, depth, seen), before),
                    **(rule or {}),
                    albedo=frame.albedo,
                    specular_length=specular_length,
                    lag_threshold=lag_threshold,
                )
        before = Surface(position, frame.normal, depth, seen)
        results.append(Past(history[:, steps.COLOR].clone(), entering[:, steps.COLOR], length.clone(), kept))
    return results


def assert_same(found: list[Past], expected: list[Past], tolerance: float) -> None:
    for a, b in zip(found, expected, strict=True):
        for image, plain in zip(a, b, strict=True):
            assert image.dtype == plain.dtype
            torch.testing.assert_close(image, plain, rtol=tolerance, atol=tolerance * plain.abs().mean().item())


WAYS = {
    "nothing": shot("motion", "previous_position", speed=0.0),
    "motion": shot("previous_position"),
    "positions": shot("motion", "previous_position"),
    "previous positions": shot("motion"),
    "without normals": shot("motion", "previous_position", "normal"),
    "without albedo": shot("motion", "albedo"),
    "without depth": shot("motion", "depth"),
    "color and motion alone": shot("albedo", "normal", "depth", "position", "previous_position"),
    "two images": shot("previous_position", batch=2),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("rule", [{}, BMFR, {"alpha_min": 0.4}], ids=str)
def test_the_history_is_that_of_the_reference(way: str, rule: dict[str, Any]) -> None:
    frames = WAYS[way]
    if "rule" in rule and (frames[0].normal is None or frames[0].position is None):
        with pytest.raises(ValueError, match="needs it in both frames"):
            passed(frames, "numba", rule)
        return
    if way == "without normals":
        # Else a neighbour lies too far off.
        rule = {**rule, "position_limit": 0.2}
    expected = passed(frames, "torch", rule)
    assert expected[5].length.max() > 3
    assert_same(passed(frames, "numba", rule), expected, 1e-9)


@pytest.mark.parametrize(
    "settings",
    [
        {"lag_threshold": math.inf},
        {"lag_threshold": 0.1},
        {"specular_length": 0},
        {"specular_length": math.inf},
        {"limit": math.inf},
        {"limit": 2.0, "window": 3},
        {"limit": 5.0, "window": 11},
    ],
    ids=str,
)
def test_settings(settings: dict[str, Any]) -> None:
    frames = WAYS["motion"]
    assert_same(passed(frames, "numba", **settings), passed(frames, "torch", **settings), 1e-9)


@pytest.mark.parametrize("way", ["nothing", "motion"])
def test_some_of_these_histories_are_short(way: str) -> None:
    """Otherwise there would be nothing to compare."""
    lagging, past = passed(WAYS[way], "torch", lag_threshold=math.inf)[-1], passed(WAYS[way], "torch")[-1]
    assert 0.1 < (past.length < lagging.length).double().mean() < 0.9
    alike = passed(WAYS["motion"], "torch", specular_length=math.inf)[5]
    assert 0.05 < (passed(WAYS["motion"], "torch")[5].length < alike.length).double().mean() < 0.9
    assert 0.1 < (alike.length == 1).double().mean() < 0.9


@pytest.mark.parametrize("size", [(1, 1), (1, 2), (2, 1), (1, 9), (8, 1), (3, 2), (6, 300)], ids=str)
def test_sizes(size: tuple[int, int]) -> None:
    frames = shot("previous_position", size=size)
    assert_same(passed(frames, "numba"), passed(frames, "torch"), 1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16], ids=str)
def test_other_dtypes(dtype: torch.dtype) -> None:
    frames = shot("previous_position", "position", dtype=dtype)
    found = passed(frames, "numba")
    assert found[-1].color.dtype == torch.float32
    # The reference implementation rounds what is demodulated, and what is clamped, to the dtype of the frame.
    same = [Picture(*(None if image is None else image.float() for image in frame)) for frame in frames]
    assert_same(found, passed(same, "torch"), 1e-3)


@pytest.mark.parametrize("layout", [channels_last, slice_of_pixels, every_other_column, transposed])
def test_layout_in_memory_and_threads_change_nothing(
    layout: Callable[[Tensor], Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_runtime, "PIXELS_A_THREAD", 1)
    threads, expected = torch.get_num_threads(), passed(WAYS["two images"], "numba")
    laid_out = [
        Picture(*(image if image is None or image.ndim < 4 else layout(image) for image in frame))
        for frame in WAYS["two images"]
    ]
    try:
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            for a, b in zip(passed(laid_out, "numba"), expected, strict=True):
                assert all(map(torch.equal, a, b))
    finally:
        torch.set_num_threads(threads)


def test_frames_with_derivatives_take_the_reference() -> None:
    frames = shot("previous_position", size=(96, 96), dtype=torch.float32)[:3]
    color = frames[1].color.requires_grad_()
    entering = steps.incoming(color, frames[1].albedo)
    history = steps.without_history(steps.incoming(frames[0].color, frames[0].albedo))
    surface = Surface(frames[1].position, frames[1].normal, frames[1].depth)
    blended = steps.blend(
        entering, history, torch.ones_like(color[:, :1]), frames[1].motion, surface, surface, lag_threshold=2.0
    )
    gradient = torch.autograd.grad(blended.color.sum(), color)[0]
    assert gradient.isfinite().all()
    assert gradient.abs().max() > 0
    with pytest.raises(ValueError, match="found 'numba', which has no derivatives of this op"):
        passed(frames, "numba")


@pytest.mark.parametrize("with_albedo", [True, False])
@pytest.mark.parametrize("limit", [30.0, 0.5, math.inf])
def test_incoming_color_is_demodulated_and_clamped(limit: float, with_albedo: bool) -> None:
    frame = WAYS["motion"][0]
    assert frame.albedo is not None
    color = demodulate(frame.color, frame.albedo) if with_albedo else frame.color
    expected = clamp_fireflies(color, limit=limit)
    given = frame.albedo if with_albedo else None
    for limits in (limit, torch.full((1, 1, 1, 1), limit)):
        for backend in ("numba", "torch"):
            found = by(backend, steps.incoming)(frame.color, given, limits, 7)
            assert_enters(found, expected)


def test_every_image_has_its_own_limit_of_fireflies() -> None:
    frame = WAYS["two images"][0]
    limits = torch.tensor([2.0, math.inf]).reshape(-1, 1, 1, 1)
    alone = [
        clamp_fireflies(image, limit=limit) for image, limit in zip(frame.color.split(1), (2.0, math.inf), strict=True)
    ]
    assert not torch.equal(alone[0], frame.color[:1])
    assert torch.equal(clamp_fireflies(frame.color, limit=limits), torch.cat(alone))
    for backend in ("numba", "torch"):
        assert_enters(by(backend, steps.incoming)(frame.color, None, limits, 7), torch.cat(alone))


def assert_enters(found: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(found[:, :3], expected, rtol=1e-14, atol=0)
    torch.testing.assert_close(found[:, 3:4], expected.mean(1, keepdim=True) ** 0.25, rtol=1e-14, atol=0)
    torch.testing.assert_close(found[:, 4:], expected.mean(1, keepdim=True) ** 0.5, rtol=1e-14, atol=0)


@pytest.mark.parametrize("scale", [1e-37, 1e30])
def test_any_exposure(scale: float) -> None:
    frames = shot("previous_position", dtype=torch.float32)
    expected = passed(frames, "numba")
    for past, dark in zip(
        expected, passed([frame._replace(color=frame.color * scale) for frame in frames], "numba"), strict=True
    ):
        torch.testing.assert_close(dark.color / scale, past.color, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("backend", ["numba", "torch"])
def test_pixels_that_found_their_surface_are_counted_image_by_image(backend: Any) -> None:
    color = torch.ones(2, 3, 10, 10)
    depth = torch.ones(2, 1, 10, 10)
    before = depth.clone()
    before[1, :, :3] = 5.0
    surfaces = (Surface(depth=depth), Surface(depth=before))
    blended = by(backend, steps.blend)(color, color, depth, None, *surfaces)
    torch.testing.assert_close(blended.kept, torch.tensor([1.0, 0.7]))
