from __future__ import annotations

from typing import Any

import kornia
import pytest
import torch
from reference_cases import by
from torch import Tensor

from mcdenoise.ops import Surface, accumulate, motion_from_position, reproject

INF, NAN = torch.inf, torch.nan


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def image(rows: list[list[float]]) -> Tensor:
    """``(1, 1, H, W)``."""
    return torch.tensor(rows, dtype=torch.float64)[None, None]


def vectors(rows: list[list[tuple[float, ...]]]) -> Tensor:
    """``(1, C, H, W)``."""
    return torch.tensor(rows, dtype=torch.float64).movedim(-1, 0)[None]


def still(height: int, width: int, batch: int = 1) -> Tensor:
    return torch.zeros(batch, 2, height, width, dtype=torch.float64)


class TestBmfrRule:
    """Results by hand, on one pixel (the upper left of 2 x 2) that was at x = 0.25, y = 0.5 of the previous frame.

    Its taps have the bilinear weights 0.375, 0.125 / 0.375, 0.125; the others moved in from outside.
    """

    motion = vectors([[(0.25, 0.5), (9.0, 0.0)], [(0.0, 9.0), (-9.0, 0.0)]])
    color = image([[1.0, 10.0], [20.0, 30.0]])
    # The upper right tap is 0.5 away, and 0.5^2 < 0.25 is false: it is discarded, whatever it holds.
    position = vectors([[(0.0, 0.0, 5.0)] * 2] * 2)
    previous_position = vectors([[(0.0, 0.0, 5.0), (0.5, 0.0, 5.0)], [(0.0, 0.49, 5.0), (0.3, 0.3, 5.1)]])
    normal = vectors([[(0.0, 1.0, 0.0)] * 2] * 2)

    def run(self, previous: Tensor, length: Tensor, previous_normal: Tensor | None = None) -> tuple[Tensor, Tensor]:
        there = self.normal if previous_normal is None else previous_normal
        return accumulate(
            self.color,
            previous,
            length,
            self.motion,
            Surface(self.position, self.normal),
            Surface(self.previous_position, there),
            alpha_min=0.2,
            rule="bmfr",
            position_limit=0.25,
            normal_limit=1.0,
        )

    def test_mean_of_the_kept_taps(self) -> None:
        accumulated, length = self.run(image([[8.0, 100.0], [2.0, 4.0]]), image([[3.0, 9.0], [4.0, 2.0]]))
        # Kept weight 0.375 + 0.375 + 0.125 = 0.875.
        # History (0.375 * 8 + 0.375 * 2 + 0.125 * 4) / 0.875 = 4.25 / 0.875 = 34 / 7.
        # Length  (0.375 * 3 + 0.375 * 4 + 0.125 * 2) / 0.875 = 2.875 / 0.875 = 23 / 7, so alpha = 7 / 30 > 0.2.
        # 7 / 30 * 1 + 23 / 30 * 34 / 7 = (49 + 782) / 210; length round(3.29) + 1.
        torch.testing.assert_close(accumulated, image([[831 / 210, 10.0], [20.0, 30.0]]), rtol=1e-12, atol=0)
        assert torch.equal(length, image([[4.0, 1.0], [1.0, 1.0]]))

    @pytest.mark.parametrize(("before", "after"), [(253.0, 254.0), (254.0, 255.0), (255.0, 255.0)])
    def test_length_saturates_at_a_byte(self, before: float, after: float) -> None:
        _, length = self.run(image([[0.0] * 2] * 2), image([[before] * 2] * 2))
        assert length[0, 0, 0, 0].item() == after

    def test_normal_limit_is_strict_as_well(self) -> None:
        # Squared distances from (0, 1, 0): 2 in the upper left, exactly 1 in the lower left, 0.4 in the lower right.
        normal = vectors([[(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)], [(0.0, 1.0, 1.0), (0.6, 0.8, 0.0)]])
        accumulated, length = self.run(image([[8.0, 100.0], [2.0, 4.0]]), image([[3.0, 9.0], [4.0, 1.0]]), normal)
        # Only the last is below the limit of 1: 0.5 * 1 + 0.5 * 4.
        torch.testing.assert_close(accumulated[0, 0, 0, 0].item(), 2.5, rtol=1e-12, atol=0)
        assert length[0, 0, 0, 0].item() == 2.0

    def test_no_tap_left(self) -> None:
        accumulated, length = self.run(image([[8.0] * 2] * 2), image([[3.0] * 2] * 2), -self.normal)
        assert torch.equal(accumulated, self.color)
        assert torch.equal(length, torch.ones_like(length))


def test_a_still_camera_averages() -> None:
    frames = draw(12, 3, 5, 7)
    history, length = frames[:1], torch.ones(1, 1, 5, 7, dtype=torch.float64)
    expected = history
    for n in range(2, 13):
        frame = frames[n - 1 : n]
        history, length = accumulate(frame, history, length, still(5, 7), alpha_min=1e-3)
        expected = torch.lerp(expected, frame, 1 / torch.full((1, 1, 5, 7), n, dtype=torch.float64))
        # They are equal to the last bit: nothing is lost by reprojecting onto the same pixel.
        assert torch.equal(history, expected)
        assert torch.equal(length, torch.full_like(length, n))
    torch.testing.assert_close(history, frames.mean(0, keepdim=True), rtol=1e-12, atol=0)


def test_without_a_surface_it_is_kornias_remap_inside_the_image() -> None:
    previous = draw(2, 3, 8, 9)
    motion = 6 * draw(2, 2, 8, 9, seed=1) - 3
    value, weight = reproject(previous, motion)
    rows, columns = torch.meshgrid(torch.arange(8.0), torch.arange(9.0), indexing="ij")
    x, y = columns + motion[:, 0], rows + motion[:, 1]
    expected = kornia.geometry.transform.remap(previous, x, y, align_corners=True)
    inside = ((x >= 0) & (x <= 8) & (y >= 0) & (y <= 7))[:, None]
    assert 0.2 < inside.double().mean().item() < 0.9
    torch.testing.assert_close(value[inside.expand_as(value)], expected[inside.expand_as(value)], rtol=1e-10, atol=0)
    torch.testing.assert_close(weight[inside], torch.ones_like(weight[inside]), rtol=1e-12, atol=0)
    # At the border kornia mixes in zeros; here they are rejected, and the weight says how much was inside.
    torch.testing.assert_close(value * weight, expected, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("nowhere", [INF, -INF, NAN])
@pytest.mark.parametrize("axis", [0, 1])
def test_no_motion_no_history(nowhere: float, axis: int) -> None:
    motion = still(1, 3)
    motion[0, axis, 0, 1] = nowhere
    motion.requires_grad_()
    previous = draw(1, 2, 1, 3).requires_grad_()
    value, weight = reproject(previous, motion)
    assert weight.flatten().tolist() == [1.0, 0.0, 1.0]
    assert value[..., 1].eq(0).all()
    gradients = torch.autograd.grad(value.sum() + weight.sum(), [previous, motion])
    assert all(gradient.isfinite().all() for gradient in gradients)


class TestEachTap:
    """All four taps weigh a quarter; one of them shows something else."""

    motion = torch.full((1, 2, 2, 2), 0.5, dtype=torch.float64)
    previous = image([[1.0, 2.0], [3.0, 100.0]])
    plane = Surface(
        position=vectors([[(0.0, 0.0, 5.0), (1.0, 0.0, 5.0)], [(0.0, 1.0, 5.0), (1.0, 1.0, 5.0)]]),
        normal=vectors([[(0.0, 0.0, -1.0)] * 2] * 2),
        depth=image([[5.0] * 2] * 2),
        label=image([[7.0] * 2] * 2),
    )

    def other(self, **changes: float) -> Surface:
        parts = {name: part.clone() for name, part in self.plane._asdict().items()}
        for name, value in changes.items():
            parts[name][0, -1, 1, 1] = value
        return Surface(**parts)

    def test_the_same_plane(self) -> None:
        # Points a unit apart, far more than 2 % of the depth, but on one plane.
        value, weight = reproject(self.previous, self.motion, self.plane, self.plane)
        assert (value[0, 0, 0, 0].item(), weight[0, 0, 0, 0].item()) == (26.5, 1.0)

    @pytest.mark.parametrize(
        "change", [{"position": 5.11}, {"position": 4.89}, {"normal": 1.0}, {"depth": INF}, {"label": 8.0}]
    )
    @pytest.mark.parametrize("content", [100.0, NAN, INF])
    def test_one_on_another_surface_is_rejected(self, change: dict[str, float], content: float) -> None:
        previous = self.previous.clone()
        previous[..., 1, 1] = content
        previous.requires_grad_()
        value, weight = reproject(previous, self.motion, self.plane, self.other(**change))
        assert (value[0, 0, 0, 0].item(), weight[0, 0, 0, 0].item()) == (2.0, 0.75)
        (gradient,) = torch.autograd.grad(value[0, 0, 0, 0], previous)
        torch.testing.assert_close(gradient, image([[1 / 3, 1 / 3], [1 / 3, 0.0]]), rtol=1e-12, atol=0)

    @pytest.mark.parametrize("change", [{"position": 5.09}, {"normal": -1.5}])
    def test_one_within_the_limits_is_kept(self, change: dict[str, float]) -> None:
        _, weight = reproject(self.previous, self.motion, self.plane, self.other(**change))
        assert weight[0, 0, 0, 0].item() == 1.0

    def test_without_one_of_its_own_label_all_are_kept(self) -> None:
        unknown = self.plane._replace(label=image([[9.0] * 2] * 2))
        value, weight = reproject(self.previous, self.motion, unknown, self.other(label=8.0))
        assert (value[0, 0, 0, 0].item(), weight[0, 0, 0, 0].item()) == (26.5, 1.0)

    def test_one_of_its_own_label_in_which_it_hardly_lies_is_not_enough(self) -> None:
        for share, expected in ((1e-4, 1.01), (0.01, 100.0)):
            motion = torch.tensor([share, 1.0], dtype=torch.float64).reshape(1, 2, 1, 1).expand(1, 2, 2, 2)
            own = self.plane._replace(label=image([[8.0] * 2] * 2))
            value, _ = reproject(image([[0.0, 0.0], [1.0, 100.0]]), motion, own, self.other(label=8.0))
            assert value[0, 0, 0, 0].item() == pytest.approx(expected, rel=1e-2)

    def test_another_surface_of_its_own_label_is_rejected(self) -> None:
        own = self.plane._replace(label=image([[8.0] * 2] * 2))
        value, weight = reproject(self.previous, self.motion, own, self.other(label=8.0, position=50.0))
        assert (value[0, 0, 0, 0].item(), weight[0, 0, 0, 0].item()) == (2.0, 0.75)

    def test_without_normals_points_must_be_near(self) -> None:
        flat = self.plane._replace(normal=None)
        _, weight = reproject(self.previous, self.motion, flat, flat)
        assert weight[0, 0, 0, 0].item() == 0.25

    def test_with_depths_only(self) -> None:
        for depth, kept in ((5.49, 1.0), (5.51, 0.75), (4.51, 1.0), (4.49, 0.75)):
            there = Surface(depth=self.other(depth=depth).depth)
            _, weight = reproject(self.previous, self.motion, Surface(depth=self.plane.depth), there)
            assert weight[0, 0, 0, 0].item() == kept

    def test_a_buffer_of_only_one_surface_is_not_compared(self) -> None:
        elsewhere = self.other(position=50.0)._replace(normal=None, depth=None)
        _, weight = reproject(self.previous, self.motion, self.plane._replace(position=None), elsewhere)
        assert weight[0, 0, 0, 0].item() == 1.0


def random_surfaces() -> tuple[Surface, Surface]:
    frames = []
    for seed in (0, 1):
        depth = 2 + 0.2 * draw(1, 1, 16, 16, seed=seed)
        normal = torch.nn.functional.normalize(draw(1, 3, 16, 16, seed=seed + 2) - 0.2, dim=1)
        position = torch.cat([0.2 * draw(1, 2, 16, 16, seed=seed + 4), depth], 1)
        frames.append(Surface(position, normal, depth))
    return frames[0], frames[1]


@pytest.mark.parametrize("parts", [("position", "normal", "depth"), ("position", "depth"), ("depth",)])
@pytest.mark.parametrize("factor", [1000.0, 1e-3])
def test_relative_limits_do_not_depend_on_the_unit(parts: tuple[str, ...], factor: float) -> None:
    def scene(surface: Surface, factor: float) -> Surface:
        scales = {"position": factor, "normal": 1.0, "depth": factor}
        return Surface(**{part: getattr(surface, part) * scales[part] for part in parts})

    here, there = random_surfaces()
    previous, motion = draw(1, 3, 16, 16), 4 * draw(1, 2, 16, 16, seed=9) - 2
    limit = 0.05
    outcome = reproject(previous, motion, scene(here, 1), scene(there, 1), position_limit=limit)
    scaled = reproject(previous, motion, scene(here, factor), scene(there, factor), position_limit=limit)
    decided = outcome[1][..., 2:-2, 2:-2]
    assert 0.1 < decided.mean().item() < 0.9  # else nothing is tested
    for a, b in zip(outcome, scaled, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("beyond", [INF, NAN, 0.0])
def test_background_matches_background_only(beyond: float) -> None:
    # Four pairs of here and there: hit and hit, hit and sky, sky and hit, sky and sky.
    here = image([[5.0, 5.0, INF, INF]])
    there = image([[5.0, INF, 5.0, INF]])
    point = vectors([[(0.0, 0.0, 5.0)] * 4])
    normal = vectors([[(0.0, 0.0, -1.0)] * 4])
    surfaces = []
    for depth in (here, there):
        # Renderers write anything for the position of a miss.
        position = torch.where(depth.isinf(), beyond, point)
        surfaces.append(Surface(position, normal, depth))
    _, weight = reproject(draw(1, 3, 1, 4), still(1, 4), *surfaces)
    assert weight.flatten().tolist() == [1.0, 0.0, 0.0, 1.0]
    _, weight = reproject(draw(1, 3, 1, 4), still(1, 4), Surface(depth=here), Surface(depth=there))
    assert weight.flatten().tolist() == [1.0, 0.0, 0.0, 1.0]


def test_nan_of_a_rejected_tap_does_not_reach_the_history() -> None:
    color, previous = draw(1, 1, 1, 2), draw(1, 1, 1, 2, seed=1)
    previous[..., 1] = NAN
    here, there = Surface(depth=image([[5.0, 5.0]])), Surface(depth=image([[5.0, 9.0]]))
    accumulated, _ = accumulate(color, previous, image([[1.0, 1.0]]), still(1, 2), here, there)
    assert accumulated.isfinite().all()


def perspective(batch: int = 1) -> Tensor:
    """Row vectors: clip x = 2 x, y = 4 y, z = z - 1, w = z."""
    matrix = torch.zeros(batch, 4, 4, dtype=torch.float64)
    matrix[:, 0, 0], matrix[:, 1, 1], matrix[:, 2, 2], matrix[:, 2, 3], matrix[:, 3, 2] = 2.0, 4.0, 1.0, 1.0, -1.0
    return matrix


def test_motion_of_a_known_point() -> None:
    position = vectors([[(0.5, 0.25, 4.0)] * 4] * 2)
    # u = (2 * 0.5 / 4 + 1) / 2 = 0.625 and v = (4 * 0.25 / 4 + 1) / 2 = 0.625: x = 2.5 of 4, y = 1.25 of 2.
    motion = motion_from_position(position, perspective())
    expected_x = torch.tensor([2.0, 1.0, 0.0, -1.0]).double().expand(2, 4)
    expected_y = torch.tensor([[0.75], [-0.25]]).double().expand(2, 4)
    assert torch.equal(motion[0, 0], expected_x)
    assert torch.equal(motion[0, 1], expected_y)


@pytest.mark.parametrize(("height", "width"), [(5, 7), (1, 1), (8, 3)])
def test_a_still_camera_gives_no_motion(height: int, width: int) -> None:
    centres = [torch.arange(size, dtype=torch.float64) + 0.5 for size in (height, width)]
    rows, columns = torch.meshgrid(*centres, indexing="ij")
    depth = 1 + 9 * draw(2, height, width)
    x, y = (2 * columns / width - 1) / 2 * depth, (2 * rows / height - 1) / 4 * depth
    motion = motion_from_position(torch.stack([x, y, depth], 1), perspective(2))
    torch.testing.assert_close(motion, still(height, width, batch=2), rtol=0, atol=1e-13)


def test_points_behind_the_camera_have_no_motion_and_no_history() -> None:
    position = vectors([[(0.0, 0.0, 4.0), (0.0, 0.0, -4.0), (0.0, 0.0, 0.0), (INF, 0.0, 4.0), (NAN, 0.0, 4.0)]])
    motion = motion_from_position(position, perspective())
    assert motion.isfinite().flatten(2).tolist() == [[[True, False, False, False, False]] * 2]
    _, weight = reproject(draw(1, 1, 1, 5), motion)
    assert weight.flatten().tolist()[1:] == [0.0] * 4


def test_motion_keeps_float32_for_half_precision() -> None:
    # 1000.25 is no bfloat16.
    position = torch.zeros(1, 3, 1, 2001, dtype=torch.bfloat16)
    position[:, 2] = 1
    motion = motion_from_position(position, perspective().bfloat16())
    assert motion.dtype == torch.float32
    assert motion[0, 0, 0].tolist() == [1000.0 - x for x in range(2001)]


def test_settings_reach_the_test_of_the_surface() -> None:
    arguments: tuple[Any, ...] = (draw(1, 3, 1, 2), draw(1, 3, 1, 2), image([[3.0, 3.0]]), still(1, 2))
    surfaces = (Surface(depth=image([[5.0, 5.0]])), Surface(depth=image([[5.4, 5.6]])))
    assert accumulate(*arguments, *surfaces)[1].flatten().tolist() == [4.0, 1.0]
    assert accumulate(*arguments, *surfaces, position_limit=0.2)[1].flatten().tolist() == [4.0, 4.0]


class TestNothingMoves:
    """A motion of ``None`` is a motion of zeros, to the last bit."""

    def surfaces(self, seed: int) -> Surface:
        position, depth = draw(2, 3, 96, 110, seed=seed), draw(2, 1, 96, 110, seed=seed) + 1
        normal = torch.nn.functional.normalize(draw(2, 3, 96, 110, seed=seed + 1) - 0.5)
        depth[..., :9, :] = INF
        return Surface(position.float(), normal.float(), depth.float())

    @pytest.mark.parametrize("backend", ["torch", "numba"])
    @pytest.mark.parametrize("rule", ["relative", "bmfr"])
    @pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
    def test_bit_by_bit(self, backend: Any, rule: Any, dtype: torch.dtype) -> None:
        if backend == "numba":
            pytest.importorskip("numba", reason="the fast backend is in the extra mcdenoise[fast]")
        color, previous = (draw(2, 3, 96, 110, seed=seed).to(dtype) for seed in (1, 2))
        length = (draw(2, 1, 96, 110, seed=3) * 40).round() + 1
        here, there = self.surfaces(4), self.surfaces(4)
        assert there.normal is not None
        # Half of the pixels show another surface than before.
        changed = draw(2, 1, 96, 110, seed=5) < 0.5
        there = there._replace(normal=torch.where(changed, -there.normal, there.normal))
        limits = {"position_limit": 0.1, "normal_limit": 0.3} if rule == "bmfr" else {}
        arguments, settings = (color, previous, length.to(dtype)), {"rule": rule, **limits}
        zeros = still(96, 110, 2).to(dtype)
        function = by(backend, accumulate)
        expected = function(*arguments, zeros, here, there, **settings)
        for result, known in zip(function(*arguments, None, here, there, **settings), expected, strict=True):
            assert torch.equal(result, known)
        assert 0.4 < (expected[1] == 1).float().mean() < 0.6

    def test_reprojection_and_its_derivatives(self) -> None:
        previous, here = draw(1, 3, 5, 6).requires_grad_(), draw(1, 1, 5, 6, seed=1) + 1
        surfaces = Surface(depth=here), Surface(depth=here * torch.tensor([1.0, 1.5]).repeat(3))
        expected = reproject(previous, still(5, 6), *surfaces)
        results = reproject(previous, None, *surfaces)
        assert all(torch.equal(result, known) for result, known in zip(results, expected, strict=True))
        slopes = [torch.autograd.grad(value.square().sum(), previous)[0] for value, _ in (results, expected)]
        assert torch.equal(*slopes)
        assert results[1].unique().tolist() == [0, 1]


def test_motion_keeps_its_precision_under_autocast() -> None:
    """The scene is 100 units from the origin, where bfloat16 would be off by 64 pixels."""
    position = 100 + torch.rand(1, 3, 36, 64)
    matrix = torch.eye(4)[None] * 0.5
    matrix[:, 3, 3] = 6
    expected = by("torch", motion_from_position)(position, matrix)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(by("torch", motion_from_position)(position, matrix), expected)
