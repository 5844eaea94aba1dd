"""The vocabulary of buffers: what a frame refuses, what it repairs, and what it leaves alone."""

import pytest
import torch
from refusals import refused
from torch import Tensor
from torch.utils import _pytree as pytree

from mcdenoise.frame import BUFFERS, Frame, Hints, Skip
from mcdenoise.ops import motion_from_position

NAN, INF = float("nan"), float("inf")
SIZE = (5, 7)


def plane(channels: int, value: float = 0.5) -> Tensor:
    return torch.full((2, channels, *SIZE), value)


def full_frame() -> Frame:
    buffers = {name: plane(spec.channels) for name, spec in BUFFERS.items()}
    return Frame(**buffers, view_projection=torch.eye(4).expand(2, 4, 4))


@pytest.mark.parametrize(
    ("name", "value", "expected", "found"),
    [
        ("color", plane(4), "(B, 3, H, W)", "(2, 4, 5, 7)"),
        ("color", plane(3)[0], "(B, 3, H, W)", "(3, 5, 7)"),
        ("color", None, "torch.Tensor", "NoneType"),
        ("color", plane(3).to(torch.uint8), "floating-point", "torch.uint8"),
        ("albedo", plane(3).numpy(), "torch.Tensor", "ndarray"),
        ("albedo", plane(3)[..., 1:], "(2, 3, 5, 7)", "(2, 3, 5, 6)"),
        ("normal", plane(3)[:1], "(2, 3, 5, 7)", "(1, 3, 5, 7)"),
        ("depth", plane(3), "(2, 1, 5, 7)", "(2, 3, 5, 7)"),
        ("position", plane(3).to("meta"), "on cpu", "on meta"),
        ("view_projection", torch.eye(4), "(2, 4, 4)", "(4, 4)"),
        ("samples", plane(3)[:, None, ..., 1:].expand(2, 4, 3, 5, 6), "(2, 4, 3, 5, 7)", "(2, 4, 3, 5, 6)"),
    ],
)
def test_a_mismatch_names_buffer_expected_and_found(name: str, value: object, expected: str, found: str) -> None:
    message = refused(Frame, **{"color": plane(3), name: value})
    assert message.startswith(f"buffer '{name}': expected ")
    wanted, _, got = message.partition(", found ")
    assert expected in wanted
    assert found in got


@pytest.mark.parametrize(("name", "bad"), [("albedo", NAN), ("depth", NAN), ("depth", -INF), ("position", INF)])
def test_values_that_are_not_finite_are_refused_with_their_place(name: str, bad: float) -> None:
    value = plane(BUFFERS[name].channels)
    value[1, 0, 3, 4] = bad
    message = refused(Frame(color=plane(3), **{name: value}).validate)
    assert message.startswith(f"buffer '{name}': expected finite")
    assert "found 1 NaN or infinite ones, first at row 3, column 4" in message


@pytest.mark.parametrize(
    ("name", "value", "clamped"),
    [
        ("albedo", 1.3, 1.0),
        ("albedo", -0.001, 0.0),
        ("normal", 1.0005, 1.0),
        ("depth", -0.001, 0.0),
        ("specular_albedo", 1.5, 1.0),
    ],
)
def test_a_small_overshoot_is_clamped(name: str, value: float, clamped: float) -> None:
    clean, replaced = Frame(color=plane(3), **{name: plane(BUFFERS[name].channels, value)}).validate()
    assert replaced == 0
    assert (dict(clean.items())[name] == clamped).all()


@pytest.mark.parametrize(
    ("name", "value"), [("albedo", 255.0), ("normal", 128.0), ("depth", -1.0), ("reference", 1e38)]
)
def test_values_far_outside_their_range_are_refused(name: str, value: float) -> None:
    message = refused(Frame(color=plane(3), **{name: plane(BUFFERS[name].channels, value)}).validate)
    spec = BUFFERS[name]
    assert message.startswith(f"buffer '{name}': expected values in [{spec.low:g}, {spec.high:g}]")
    assert message.endswith(f"found [{value:g}, {value:g}]")


def test_a_lamp_among_reflectances_is_clamped_with_a_warning() -> None:
    albedo = plane(3, 0.5)
    albedo[..., 0] = 93
    with pytest.warns(UserWarning, match=r"'albedo': .* 93"):
        clean, _ = Frame(color=plane(3), albedo=albedo).validate()
    assert (clean.albedo[..., 0] == 1).all()
    assert (clean.albedo[..., 1:] == 0.5).all()


def test_an_extra_buffer_is_checked_for_its_size_and_its_values() -> None:
    assert "buffer 'crypto'" in refused(Frame, color=plane(3), extra={"crypto": plane(5)[..., 1:]})
    assert "buffer 'crypto'" in refused(Frame, color=plane(3), extra={"crypto": plane(5).long()})
    assert "buffer 'crypto'" in refused(Frame(color=plane(3), extra={"crypto": plane(5, NAN)}).validate)
    assert "buffer 'crypto'" in refused(Frame, color=plane(3), extra={"crypto": plane(5)[:, :0]})
    assert "buffer 'samples'" in refused(Frame, color=plane(3), samples=plane(3)[:, None][:, :0])
    assert Frame(color=plane(3), extra={"crypto": plane(5, -INF)}).validate()[1] == 0


def test_a_part_of_a_frame_is_a_view_with_the_statistics_of_the_whole() -> None:
    statistics = {"exposure": torch.ones(2, 1, 1, 1)}
    skip = Skip(torch.ones(2, 1, *SIZE, dtype=torch.bool), plane(3))
    samples, crypto = torch.rand(2, 4, 3, *SIZE), torch.rand(2, 5, *SIZE)
    frame = full_frame().replace(samples=samples, extra={"crypto": crypto}, statistics=statistics, skip=skip)
    part = frame.crop(slice(1, 4), slice(2, 7))
    assert part.size == (3, 5)
    assert part.buffers == frame.buffers
    assert torch.equal(part.samples, samples[..., 1:4, 2:7])
    assert torch.equal(part.extra["crypto"], crypto[..., 1:4, 2:7])
    for name, value in part.replace(view_projection=None).items():
        assert value.untyped_storage().data_ptr() == dict(frame.items())[name].untyped_storage().data_ptr(), name
    assert part.statistics is statistics
    assert part.skip is None


def test_a_part_of_a_frame_has_the_camera_of_that_part() -> None:
    position, camera = torch.rand(2, 3, *SIZE), torch.eye(4).repeat(2, 1, 1) + 0.1 * torch.rand(2, 4, 4)
    frame, rows, columns = Frame(plane(3), position=position, view_projection=camera), slice(1, 4), slice(-5, None)
    part = frame.crop(rows, columns)
    expected = motion_from_position(position, camera)[..., rows, columns]
    torch.testing.assert_close(motion_from_position(part.position.contiguous(), part.view_projection), expected)


def test_depth_is_the_clip_w_of_positions() -> None:
    camera = torch.eye(4).repeat(2, 1, 1)
    camera[:, :, 3] = torch.tensor([0.0, 0.0, 2.0, -1.0])
    position = torch.rand(2, 3, *SIZE)
    position[:, 2, 0] = -1
    frame = Frame(color=plane(3), position=position, view_projection=camera)
    depth = 2 * position[:, 2:] - 1
    assert torch.equal(frame.with_depth().depth, torch.where(depth > 0, depth, INF))
    # It goes no further than what it needs, and never before a depth that is there.
    for other in (frame.replace(position=None), frame.replace(view_projection=None), frame.replace(depth=plane(1))):
        assert other.with_depth() is other


def loaded_frame() -> Frame:
    return full_frame().replace(
        samples=torch.rand(2, 4, 3, *SIZE),
        extra={"crypto": plane(5), "id": plane(1)},
        statistics={"exposure": torch.ones(2, 1, 1, 1)},
        skip=Skip(torch.ones(2, 1, *SIZE, dtype=torch.bool), plane(3)),
        hints=Hints(still=True, stages=False),
    )


@pytest.mark.parametrize("make", [full_frame, loaded_frame, lambda: Frame(color=plane(3))])
def test_a_frame_comes_apart_and_together(make: object) -> None:
    frame = make()  # type: ignore[operator]
    leaves, spec = pytree.tree_flatten(frame)
    assert all(isinstance(leaf, Tensor) for leaf in leaves)
    again = pytree.tree_unflatten(leaves, spec)
    assert isinstance(again, Frame)
    assert again.hints == frame.hints
    assert again.buffers == frame.buffers
    for (name, one), (other, two) in zip(again.items(), frame.items(), strict=True):
        assert name == other
        assert one is two
    assert again.statistics.keys() == frame.statistics.keys()
    assert (again.skip is None) is (frame.skip is None)
    # The structure of what a renderer hands over can be written to a file, as torch.export does.
    spec = pytree.tree_structure(frame.replace(skip=None))
    assert pytree.treespec_loads(pytree.treespec_dumps(spec)) == spec
    paths = [pytree.keystr(path) for path, _ in pytree.tree_flatten_with_path(frame)[0]]
    assert paths[0] == ".color"
    assert len(set(paths)) == len(leaves)
