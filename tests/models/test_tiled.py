"""Methods in tiles: the images of the whole, within a limit of memory."""

import re
from typing import Any

import numpy as np
import pytest
import torch
from planes import synthetic
from refusals import refused
from torch import Tensor
from toys import Blur, Mean, Same, cascade, frame_of, small

from mcdenoise import Denoiser, Frame, create_model
from mcdenoise.frame import Skip
from mcdenoise.models import Needs, Output, Tiled
from mcdenoise.models._interface import prepared
from mcdenoise.models._memory import Division, Frames
from mcdenoise.models._wrapper import FromBuffers, parts_of
from mcdenoise.models.tiled import Region, regions
from mcdenoise.nn.unet import Live
from mcdenoise.ops._window import mirrored

BUFFERS = frozenset({"color", "albedo", "normal", "depth"})
CPU = torch.device("cpu")


def test_a_method_may_find_an_alpha_in_tiles() -> None:
    def opaque(frame: Frame, state: Any = None) -> Any:
        return Output(frame.color, alpha=frame.color[:, :1] / 2), None

    opaque.needs = Needs(trainable=False, reach=0)  # type: ignore[attr-defined]
    color = torch.rand(1, 3, 70, 80)
    output = Tiled(opaque, side=32)(Frame(color))[0]  # type: ignore[arg-type]
    assert torch.equal(output.alpha, color[:, :1] / 2)


@pytest.mark.parametrize(("precision", "tile"), [("float32", 64), ("float32", 160), ("bfloat16", 96)])
def test_tiles_give_the_images_of_whole_frames(precision: Any, tile: int) -> None:
    model = cascade()
    # Odd sizes, and a sky that is copied: its rectangle is split, too. One after the other, since both set the tiles.
    frames = [synthetic(331, 237, seed) for seed in range(3)]
    whole = Denoiser(model, precision=precision)
    outputs = [whole.output(frame) for frame in frames]
    assert whole.report.tiles.startswith("whole frames: features of the network within 2 GB")
    tiled = Denoiser(model, precision=precision, tile=tile)
    for frame, expected in zip(frames, outputs, strict=True):
        output = tiled.output(frame)
        columns, rows = -(-331 // tile), -(-237 // tile)
        assert tiled.report.tiles.startswith(f"{columns} x {rows} tiles of up to ")
        assert list(output.stages) == list(expected.stages) == ["noisy", "accumulated", "initial"]
        assert torch.equal(output.stages["accumulated"], expected.stages["accumulated"])
        for a, b in ((output.stages["initial"], expected.stages["initial"]), (output.image, expected.image)):
            # Convolutions of small images are summed in another order; of bfloat16 each sum is rounded to 8 bits.
            bound = 3e-6 if precision == "float32" else 3e-2
            # A pixel of 16 is rounded to 2e-6, whatever the mean is.
            assert ((a - b).abs() < bound * (b.abs() + b.abs().mean()) / 2).all()
            assert (a - b).abs().mean() < bound / 10 * b.abs().mean()


def test_two_denoisers_of_one_model_have_tiles_of_their_own() -> None:
    model, frame = cascade(), synthetic(160, 96)
    whole, tiled = Denoiser(model), Denoiser(model, tile=64)
    assert [tiles.side for tiles in parts_of(model, Tiled)] == [None, None]
    for denoiser, side in ((whole, None), (tiled, 64), (whole, None), (tiled, 64)):
        denoiser(frame)
        assert {tiles.side for tiles in parts_of(model, Tiled)} == {side}


def test_frames_of_more_than_a_million_pixels_are_prepared_by_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = [synthetic(331, 237, seed) for seed in range(3)]
    broken = frames[1].color.clone()
    broken[0, 0, ::23, ::31] = torch.nan
    frames[1] = frames[1].replace(color=broken)
    model = cascade()
    at_once = Denoiser(model)
    expected = [at_once.output(frame) for frame in frames]
    assert at_once.report.replaced_pixels == 0
    monkeypatch.setattr("mcdenoise.ops._rows._PIXELS", 331 * 10)
    by_rows = Denoiser(model)
    for number, (frame, output) in enumerate(zip(frames, expected, strict=True)):
        found = by_rows.output(frame)
        assert torch.equal(found.image, output.image)
        for name, image in output.stages.items():
            assert torch.equal(found.stages[name], image), name
        assert by_rows.report.replaced_pixels == (11 * 11 if number == 1 else 0)


@pytest.mark.parametrize("size", [(96, 160), (99, 131), (20, 30)])
@pytest.mark.parametrize("side", [32, 64])
def test_a_toy_is_tiled_without_knowing_it(side: int, size: tuple[int, int]) -> None:
    toy, frame = Blur(), frame_of(*size, batch=2)
    expected, _ = Blur()(frame)
    output, state = Tiled(toy, side)(frame)
    assert state is None
    torch.testing.assert_close(output.image, expected.image, rtol=1e-6, atol=1e-7)
    # Each tile, and two pixels on each side of it, as far as the image goes.
    rows, columns = (-(-length // side) for length in size)
    inner = [(size[0] + 4 * (rows - 1)), (size[1] + 4 * (columns - 1))]
    assert toy.pixels == inner[0] * inner[1]


def test_a_method_that_needs_the_whole_image_is_not_tiled() -> None:
    frame, seen = frame_of(96, 160), []

    def whole(color: Tensor) -> Tensor:
        seen.append(tuple(color.shape[-2:]))
        return color - color.mean((2, 3), keepdim=True) + 1

    for model in (Tiled(FromBuffers(whole), 32), Tiled(FromBuffers(whole))):
        assert model.halo is None
        model(frame)
    assert seen == [(96, 160)] * 2
    # A method whose blocks begin at other multiples than tiles do is not tiled either.
    toy = Blur()
    toy.needs = Needs(reach=2, stride=24)
    assert Tiled(toy, 32).halo is None
    assert Tiled(FromBuffers(whole, reach=0), 32).halo == 0


@pytest.mark.parametrize(("reach", "stride", "halo"), [(2, 1, 2), (2, 8, 8), (57, 8, 64), (0, 32, 0)])
def test_a_halo_holds_the_reach_in_whole_strides(reach: int, stride: int, halo: int) -> None:
    toy = Same()
    toy.needs = Needs(reach=reach, stride=stride)
    assert Tiled(toy).halo == halo


def test_tiles_begin_at_multiples_of_the_stride() -> None:
    """A U-Net that pools eight by eight pixels requires it."""

    class Blocks(Same):
        needs = Needs(reach=7, stride=8)

        def forward(self, frame: Frame, state: Any = None) -> Any:
            means = torch.nn.functional.avg_pool2d(frame.color, 8, ceil_mode=True, count_include_pad=False)
            wide = means.repeat_interleave(8, -2).repeat_interleave(8, -1)
            return super().forward(frame.replace(color=wide[..., : frame.size[0], : frame.size[1]]))

    frame = frame_of(101, 163)
    torch.testing.assert_close(Tiled(Blocks(), 32)(frame)[0].image, Blocks()(frame)[0].image, rtol=1e-6, atol=1e-7)


def test_a_method_with_a_state_is_refused_in_tiles() -> None:
    toy = Mean()
    toy.needs = Needs(reach=0)
    frame = frame_of(96, 160)
    with pytest.raises(TypeError, match="state"):
        Tiled(toy, 32)(frame)
    # In one piece, the method keeps its state.
    _, state = Tiled(toy)(frame)
    assert Tiled(toy)(frame.replace(color=3 * frame.color), state)[0].image.equal(2 * frame.color)


def test_known_pixels_are_not_computed() -> None:
    frame, toy = frame_of(237, 331), Blur()
    known = torch.full_like(frame.color, 7.0)
    for top, left in ((0, 0), (100, 131), (170, 250)):
        mask = torch.ones(1, 1, 237, 331, dtype=torch.bool)
        mask[..., top : top + 60, left : left + 70] = False
        toy.pixels = 0
        output, _ = Tiled(toy)(frame.replace(skip=Skip(mask, known)))
        assert 60 * 70 <= toy.pixels < 0.3 * 237 * 331
        expected = Blur()(frame)[0].image
        torch.testing.assert_close(output.image[..., ~mask[0, 0]], expected[..., ~mask[0, 0]], rtol=1e-6, atol=1e-7)
    toy.pixels = 0
    output, _ = Tiled(toy)(frame.replace(skip=Skip(torch.ones_like(mask), known)))
    assert toy.pixels == 0
    assert torch.equal(output.image, known)


@torch.no_grad()
def test_around_the_image_a_network_sees_its_mirror_image() -> None:
    """As if the image were larger; in training it does not."""
    frame, (model,) = frame_of(40, 56), parts_of(small("kpcn"), Tiled)
    border = model.halo
    larger = prepared(model, frame).map(lambda image: mirrored(image, (border, border), (border, border)))
    expected = model.inner(larger)[0].image[..., border:-border, border:-border]
    model.border = border
    torch.testing.assert_close(model(frame)[0].image, expected)
    assert not torch.allclose(model.train()(frame)[0].image, expected)
    assert torch.equal(model(frame)[0].image, model.inner(frame)[0].image)


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (20, 30)])
def test_a_mirror_image_goes_on_for_ever(size: tuple[int, int]) -> None:
    image = torch.rand(2, *size, dtype=torch.float64)
    expected = np.pad(image.numpy(), [(0, 0), (16, 21), (3, 40)], mode="symmetric")
    assert np.array_equal(mirrored(image, (16, 21), (3, 40)).numpy(), expected)


def test_tiles_hold_every_pixel_once() -> None:
    for region, side in ((Region(0, 0, 237, 331), 96), (Region(64, 32, 65, 4000), 1024), (Region(0, 0, 64, 64), 64)):
        count = torch.zeros(region.bottom, region.right)
        tiles = region.split(side)
        for tile in tiles:
            assert max(tile.bottom - tile.top, tile.right - tile.left) <= side
            assert all(start % 32 == 0 for start in tile[:2])
            tile.of(count).add_(1)
        assert region.of(count).min() == count.max() == 1
        assert count.sum() == region.pixels
    assert [tile.right - tile.left for tile in Region(0, 0, 32, 1056).split(1024)] == [544, 512]


def test_rectangles_cover_needed_pixels_once_and_do_not_touch() -> None:
    needed = torch.zeros(2, 1, 1000, 1400, dtype=torch.bool)
    for image, top, left in ((0, 3, 5), (0, 40, 70), (1, 500, 900), (0, 999, 1399)):
        needed[image, 0, top, left] = True
    boxes = regions(needed, 64)
    assert boxes == [Region(0, 0, 64, 96), Region(480, 896, 512, 928), Region(992, 1376, 1000, 1400)]
    covered = sum(box.of(needed).sum() for box in boxes)
    assert covered == needed.sum()


def test_the_whole_image_is_one_tile_where_tiles_would_cost_as_much() -> None:
    needed = torch.zeros(1, 1, 90, 160, dtype=torch.bool)
    assert regions(needed, 64) == []
    needed[..., 40, 80] = True
    assert regions(needed, 64) == [Region(0, 0, 90, 160)]
    assert regions(needed, 8) == [Region(32, 64, 64, 96)]


@pytest.fixture
def loaded(monkeypatch: pytest.MonkeyPatch) -> float:
    """Return the memory of a process that has loaded torch and no images, unlike the one that runs tests."""
    monkeypatch.setattr("mcdenoise.models._memory._memory_in_use", lambda device: 0.64e9)
    return 0.64e9


def division(of_pixel: int, max_memory: float | None) -> Division:
    """That of a network with so many bytes a pixel and a halo of 64 pixels."""
    toy = Same()
    toy.needs = Needs(reach=64, live=Live(0, of_pixel // 4))
    return Division(Tiled(toy), None, max_memory, CPU)


def test_the_largest_tiles_that_fit(loaded: float) -> None:
    frames = Frames((4320, 7680), BUFFERS, streaming=False)
    side, reason = division(1000, 4.0).chosen(frames)
    # Twenty channels of float32 are held: ten of the frame, four before the network and six of its results.
    left = 4e9 - loaded - 20 * 4 * 7680 * 4320
    sides = [int(side) + 128 for side in re.findall(r"(\d+)x(\d+) pixels", reason)[0]]
    assert 0.7 * left < 1000 * sides[0] * sides[1] <= left
    assert reason.endswith("all within 4 GB")
    # With less memory they are smaller, and with much of it there are none.
    assert division(4000, 4.0).chosen(frames)[0] < side
    assert division(1000, 100.0).chosen(frames)[0] is None


def test_without_a_limit_only_large_frames_are_tiled() -> None:
    model = create_model("cascaded")
    assert [each.halo for each in parts_of(model, Tiled)] == [56, 64]
    chosen = Division(model, None, None, CPU)
    full, large = (Frames(size, BUFFERS, streaming=True) for size in ((1080, 1920), (4320, 7680)))
    assert chosen.chosen(full) == (None, "whole frames: features of the network within 2 GB")
    assert chosen.chosen(large)[0] is not None
    assert chosen.has_room_ahead(large)


@pytest.mark.usefixtures("loaded")
def test_too_little_memory_is_told_with_the_least_that_works() -> None:
    frames = Frames((4320, 7680), BUFFERS, streaming=True)
    message = refused(lambda: division(500, 3.0).chosen(frames))
    least = re.match(r"max_memory: expected at least ([\d.]+) GB for frames of 7680x4320, found 3;", message)
    assert least
    cap = float(least[1]) + 0.01
    assert division(500, cap).chosen(frames)[0] is not None
    assert not division(500, cap).has_room_ahead(frames)
    assert division(500, 2 * cap).has_room_ahead(frames)
    assert "expected at least" in refused(lambda: division(500, cap - 0.1).chosen(frames))


def test_a_module_that_computes_no_tiles_has_none() -> None:
    def copy(color: Tensor) -> Tensor:
        return color

    assert "expected a model that computes tiles" in refused(lambda: Denoiser(copy, tile=64))
    assert "expected a model that computes tiles" in refused(lambda: Denoiser(copy, max_memory=4.0))
    denoiser = Denoiser(copy)
    denoiser(synthetic(64, 48))
    assert denoiser.report.tiles == "whole frames: the model computes no tiles"
    # A model whose reach is known may be wrapped in tiles.
    denoiser = Denoiser(Tiled(FromBuffers(copy, reach=0)), tile=64)
    assert denoiser(synthetic(130, 48)).shape == (1, 3, 48, 130)
    assert denoiser.report.tiles == "3 x 1 tiles of up to 64x48 pixels: as asked for"
