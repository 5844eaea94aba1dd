"""Streaming frames through a denoiser, and whole sequences to files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from mcdenoise import Denoiser, Frame, InputError, create_model
from mcdenoise.data import open_sequence
from mcdenoise.models import Denoised, save_weights

STAGES = ["validate", "plan", "accumulate", "network", "remodulate"]


def small_model() -> nn.Module:
    """A small cascade with random weights, also in the heads that start at zero."""
    torch.manual_seed(0)
    model = create_model("cascaded", width=8)
    for head in model.first.heads:
        nn.init.normal_(head.weight, std=0.02)
    return model


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    path = tmp_path / "small.safetensors"
    path.write_bytes(save_weights(small_model(), "cascaded", {"width": 8}, {}))
    return path


@pytest.fixture
def frames(small_sequence: Path) -> list[Frame]:
    sequence = open_sequence(small_sequence)
    return [sequence.frame(number) for number in sequence.numbers]


def refused(action: Callable[[], object]) -> str:
    with pytest.raises(InputError) as error:
        action()
    assert "\n" not in str(error.value)
    return str(error.value)


class Keep(nn.Module):
    """A network that changes nothing, and remembers what it saw."""

    def forward(self, color: Tensor, albedo: Tensor, normal: Tensor, depth: Tensor) -> Denoised:
        self.seen = {"color": color, "albedo": albedo, "normal": normal, "depth": depth}
        return Denoised(color * 2, color)


def test_a_shot_is_streamed(frames: list[Frame]) -> None:
    denoiser = Denoiser(small_model())
    for i, frame in enumerate(frames):
        image = denoiser(frame)
        assert image.shape == frame.color.shape
        assert image.dtype == torch.float32
        assert torch.isfinite(image).all()
        report = denoiser.report
        assert list(report.milliseconds) == STAGES
        assert all(value >= 0 for value in report.milliseconds.values())
        assert report.reset == ("" if i else "first frame")
        assert (report.replaced_pixels, report.missing) == (0, [])


def test_the_same_frames_give_the_same_images(frames: list[Frame]) -> None:
    denoiser = Denoiser(small_model())
    first = [denoiser(frame) for frame in frames]
    denoiser.reset()
    again = [denoiser(frame) for frame in frames]
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))


def test_the_past_matters_until_it_is_reset(frames: list[Frame]) -> None:
    denoiser = Denoiser(small_model())
    alone = denoiser(frames[1])
    denoiser.reset()
    denoiser(frames[0])
    with_past = denoiser(frames[1])
    assert not torch.equal(with_past, alone)
    denoiser.reset()
    assert torch.equal(denoiser(frames[1]), alone)


def test_a_module_of_your_own(frames: list[Frame]) -> None:
    network = Keep()
    images = Denoiser(network).images(frames[0])
    assert frames[0].albedo is not None
    torch.testing.assert_close(images.denoised, frames[0].color)
    torch.testing.assert_close(images.accumulated, frames[0].color)
    torch.testing.assert_close(images.initial, frames[0].color * 2)
    # Where there is a texture, the network does not see it.
    textured = (frames[0].albedo >= 0.04).all(1, keepdim=True)
    expected = torch.where(textured, frames[0].color / frames[0].albedo.clamp_min(0.04), frames[0].color)
    torch.testing.assert_close(network.seen["color"], expected)
    assert torch.equal(network.seen["depth"], frames[0].depth)


def test_missing_features_are_told_and_constant() -> None:
    network = Keep()
    denoiser = Denoiser(network)
    denoiser(Frame(color=torch.rand(1, 3, 9, 7)))
    assert denoiser.report.missing == ["albedo", "normal", "depth"]
    assert [network.seen[name].unique().tolist() for name in ("albedo", "normal", "depth")] == [[1], [0], [1]]
    denoiser(Frame(color=torch.rand(1, 3, 9, 7), normal=torch.zeros(1, 3, 9, 7)))
    assert denoiser.report.missing == ["albedo", "depth"]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), -1.0])
def test_an_invalid_pixel_is_replaced_and_counted(frames: list[Frame], value: float) -> None:
    broken, mended = frames[0].color.clone(), frames[0].color.clone()
    broken[0, 1, 12, 3] = value
    window = frames[0].color[0, :, 11:14, 2:5].reshape(3, 9)
    mended[0, :, 12, 3] = window[:, [0, 1, 2, 3, 5, 6, 7, 8]].mean(1)
    denoiser = Denoiser(small_model())
    image = denoiser(frames[0].replace(color=broken))
    assert denoiser.report.replaced_pixels == 1
    assert torch.isfinite(image).all()
    # As if the pixel had been rendered like that: nothing else remembers it, now or in the next frame.
    other = Denoiser(small_model())
    torch.testing.assert_close(image, other(frames[0].replace(color=mended)))
    torch.testing.assert_close(denoiser(frames[1]), other(frames[1]))
    assert (denoiser.report.replaced_pixels, other.report.replaced_pixels) == (0, 0)


@pytest.mark.parametrize("name", ["albedo", "normal", "depth", "position"])
def test_an_invalid_feature_is_refused_and_leaves_the_past_alone(frames: list[Frame], name: str) -> None:
    denoiser = Denoiser(small_model())
    denoiser(frames[0])
    broken = getattr(frames[1], name).clone()
    broken[0, 0, 2, 3] = float("nan")
    message = refused(lambda: denoiser(frames[1].replace(**{name: broken})))
    assert f"buffer '{name}'" in message
    assert "row 2, column 3" in message
    after = denoiser(frames[1])
    denoiser.reset()
    denoiser(frames[0])
    assert torch.equal(denoiser(frames[1]), after)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_frames_of_any_precision(dtype: torch.dtype) -> None:
    torch.manual_seed(0)
    frame = Frame(color=torch.rand(1, 3, 9, 7).to(dtype), depth=torch.ones(1, 1, 9, 7).to(dtype))
    denoiser = Denoiser(small_model())
    image = denoiser(frame)
    denoiser.reset()
    assert image.dtype == torch.float32
    assert torch.equal(image, denoiser(frame.to(torch.float32)))


def test_images_of_a_batch_are_denoised_alike(frames: list[Frame]) -> None:
    def pair(first: Frame, second: Frame) -> Frame:
        return Frame(**{name: torch.cat([value, getattr(second, name)]) for name, value in first.items()})

    both = Denoiser(small_model())
    both(pair(frames[0], frames[2]))
    together = both(pair(frames[1], frames[3]))
    for i, (before, frame) in enumerate(((frames[0], frames[1]), (frames[2], frames[3]))):
        one = Denoiser(small_model())
        one(before)
        torch.testing.assert_close(together[i : i + 1], one(frame), rtol=1e-4, atol=1e-5)


def test_a_change_of_size_starts_a_new_shot(frames: list[Frame]) -> None:
    denoiser = Denoiser(small_model())
    denoiser(frames[0])
    image = denoiser(Frame(color=torch.rand(1, 3, 11, 13)))
    assert image.shape == (1, 3, 11, 13)
    assert denoiser.report.reset == "size change"


@pytest.mark.parametrize("device", ["nowhere", "meta", "hpu", "cuda:99"])
def test_a_device_that_is_not_there(device: str) -> None:
    assert f"device '{device}': expected one that torch can use" in refused(lambda: Denoiser(Keep(), device=device))


def test_models_by_name(weights: Path, frames: list[Frame]) -> None:
    by_name, by_module = Denoiser("cascaded", weights=weights), Denoiser(small_model())
    # Weights are stored in half precision.
    torch.testing.assert_close(by_name(frames[0]), by_module(frames[0]), rtol=1e-2, atol=1e-2)
    assert "expected one of" in refused(lambda: Denoiser("oidn"))
    assert "expected weights of model 'pixel'" in refused(lambda: Denoiser("pixel", weights=weights))


# Precision


def test_bfloat16_is_close_to_float32(frames: list[Frame]) -> None:
    exact, rounded = Denoiser(small_model()), Denoiser(small_model(), precision="bfloat16")
    for frame in frames:
        images, half = exact.images(frame), rounded.images(frame)
        # Only the network is rounded.
        assert torch.equal(half.noisy, images.noisy)
        assert torch.equal(half.accumulated, images.accumulated)
        for name in ("initial", "denoised"):
            expected, image = getattr(images, name), getattr(half, name)
            assert image.dtype == torch.float32
            error = (image - expected).abs()
            # Measured at most: 6e-4 of the mean, and 9e-4 of the largest value.
            assert error.mean() < 2e-3 * expected.mean()
            assert error.max() < 3e-3 * expected.max()
            assert not torch.equal(image, expected)


def test_a_network_that_hands_out_bfloat16_still_gives_float32() -> None:
    class Copy(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.conv = nn.Conv2d(3, 3, 1)

        def forward(self, color: Tensor, albedo: Tensor, normal: Tensor, depth: Tensor) -> Denoised:
            image = self.conv(color)
            self.seen = image.dtype
            return Denoised(image, image)

    for buffers in ({}, {"albedo": torch.rand(1, 3, 9, 7)}):
        model = Copy()
        images = Denoiser(model, precision="bfloat16").images(Frame(color=torch.rand(1, 3, 9, 7), **buffers))
        assert model.seen == torch.bfloat16
        assert images.initial.dtype == images.denoised.dtype == images.accumulated.dtype == torch.float32


@pytest.mark.parametrize("precision", ["float16", ""])
def test_an_unknown_precision_is_refused(precision: Any) -> None:
    message = refused(lambda: Denoiser(Keep(), precision=precision))
    assert message == f"precision: expected one of float32, bfloat16, found '{precision}'"


def test_depth_comes_from_positions_and_camera(small_sequence: Path) -> None:
    sequence = open_sequence(small_sequence)
    with_depth, without = Denoiser(small_model()), Denoiser(small_model())
    for number in sequence.numbers:
        frame = sequence.frame(number)
        expected = with_depth(frame.with_depth())
        image = without(frame.replace(depth=None))
        assert without.report.missing == []
        hit = frame.normal.abs().sum(1, keepdim=True) > 0
        derived = frame.replace(depth=None).with_depth().depth
        torch.testing.assert_close(derived[hit], frame.depth[hit], rtol=1e-3, atol=0)
        assert image.isfinite().all()
        assert expected.shape == image.shape
