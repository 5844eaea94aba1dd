import kornia
import pytest
import torch
from reference_cases import by, draw
from torch import Tensor

from mcdenoise.ops import Surface, motion_from_position, reproject, use
from mcdenoise.ops._backend import BACKENDS

INF, NAN = torch.inf, torch.nan


def image(rows: list[list[float]]) -> Tensor:
    """``(1, 1, H, W)``."""
    return torch.tensor(rows, dtype=torch.float64)[None, None]


def vectors(rows: list[list[tuple[float, ...]]]) -> Tensor:
    """``(1, C, H, W)``."""
    return torch.tensor(rows, dtype=torch.float64).movedim(-1, 0)[None]


def still(height: int, width: int, batch: int = 1) -> Tensor:
    return torch.zeros(batch, 2, height, width, dtype=torch.float64)


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

    def test_without_normals_points_must_be_near(self) -> None:
        flat = self.plane._replace(normal=None)
        _, weight = reproject(self.previous, self.motion, flat, flat)
        assert weight[0, 0, 0, 0].item() == 0.25

    def test_with_depths_only(self) -> None:
        for depth, kept in ((5.49, 1.0), (5.51, 0.75), (4.51, 1.0), (4.49, 0.75)):
            there = Surface(depth=self.other(depth=depth).depth)
            _, weight = reproject(self.previous, self.motion, Surface(depth=self.plane.depth), there)
            assert weight[0, 0, 0, 0].item() == kept


def test_no_motion_is_one_of_zeros_to_the_last_bit() -> None:
    previous, here = draw(1, 3, 5, 6).requires_grad_(), draw(1, 1, 5, 6, seed=1) + 1
    surfaces = Surface(depth=here), Surface(depth=here * torch.tensor([1.0, 1.5]).repeat(3))
    expected = reproject(previous, still(5, 6), *surfaces)
    results = reproject(previous, None, *surfaces)
    assert all(torch.equal(result, known) for result, known in zip(results, expected, strict=True))
    slopes = [torch.autograd.grad(value.square().sum(), previous)[0] for value, _ in (results, expected)]
    assert torch.equal(*slopes)
    assert results[1].unique().tolist() == [0, 1]


def test_a_tap_of_hardly_any_weight_is_none() -> None:
    """Where only the lower right tap shows the surface, by a motion of 1e-20; the inverse of 1e-40 is infinite."""
    facing = torch.tensor([[1.0, 1.0], [1.0, -1.0]]).reshape(1, 1, 2, 2)
    normal = torch.cat([torch.zeros(1, 2, 2, 2), facing], 1)
    previous, motion = torch.ones(1, 1, 2, 2, requires_grad=True), torch.full((1, 2, 2, 2), 1e-20, requires_grad=True)
    surfaces = Surface(normal=-normal[..., :1, :1].expand_as(normal)), Surface(normal=normal)
    for backend in BACKENDS:
        with torch.no_grad(), use(backend):
            assert reproject(previous, motion, *surfaces)[1][0, 0, 0, 0] == 0
    value, _ = reproject(previous, motion, *surfaces)
    assert all(slope.isfinite().all() for slope in torch.autograd.grad(value.sum(), (previous, motion)))


def test_surfaces_of_half_precision_are_compared_alike_with_and_without_motion() -> None:
    previous, here, there = (draw(1, 3, 80, 80, seed=seed).half() for seed in range(3))
    # Their squared distance is half on average, which is the limit.
    surfaces = Surface(normal=here), Surface(normal=there)
    expected = reproject(previous, still(80, 80).half(), *surfaces)
    assert expected[1].unique().tolist() == [0, 1]
    assert all(map(torch.equal, reproject(previous, None, *surfaces), expected))


def test_motion_keeps_its_precision_under_autocast() -> None:
    """The scene is 100 units from the origin, where bfloat16 would be off by 64 pixels."""
    position = 100 + torch.rand(1, 3, 36, 64)
    matrix = torch.eye(4)[None] * 0.5
    matrix[:, 3, 3] = 6
    expected = by("torch", motion_from_position)(position, matrix)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(by("torch", motion_from_position)(position, matrix), expected)
