"""Streaming frames through a denoiser, and whole sequences to files."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from torch import Tensor, nn

import mcdenoise.denoise
from mcdenoise import Denoiser, Frame, InputError, create_model
from mcdenoise.cli import main
from mcdenoise.data import Sequence, open_sequence, read_exr, write_exr
from mcdenoise.denoise import denoise_sequence
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


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_the_command_line_sets_the_precision(
    precision: str, small_sequence: Path, weights: Path, tmp_path: Path
) -> None:
    command = ["denoise", str(small_sequence), "-o", str(tmp_path / "out"), "--weights", str(weights), "--frames", "0"]
    with pytest.raises(SystemExit) as stop:
        main([*command, "--precision", precision])
    assert stop.value.code == 0
    assert json.loads((tmp_path / "out" / "denoise.json").read_text())["precision"] == precision


# Sequences


def stored(path: Path) -> str:
    """How an EXR stores its pixels."""
    file = oiio.ImageInput.open(str(path))
    kind = str(file.spec().format)
    file.close()
    return kind


def test_a_sequence_is_written_with_its_numbers_and_metadata(small_sequence: Path, tmp_path: Path) -> None:
    sequence, out = open_sequence(small_sequence, "1-2"), tmp_path / "deep" / "out"
    for number in sequence.numbers:
        color = small_sequence / "inputs" / f"color{number}.exr"
        write_exr(color, read_exr(color)[0], ["R", "G", "B"], metadata={"Owner": f"frame {number}", "camera": 1.5})
    seen: list[tuple[bool, bool]] = []
    denoise_sequence(
        sequence,
        out,
        Denoiser(small_model()),
        "small",
        on_images=lambda frame, images: seen.append((frame.reference is None, images.noisy.equal(frame.color))),
    )
    assert seen == [(True, True)] * 2
    assert sorted(path.name for path in out.iterdir()) == ["denoise.json", "denoised1.exr", "denoised2.exr"]
    denoiser = Denoiser(small_model())
    for number in sequence.numbers:
        pixels, channels, metadata = read_exr(out / f"denoised{number}.exr")
        assert channels == ["R", "G", "B"]
        assert (metadata["Owner"], metadata["camera"]) == (f"frame {number}", 1.5)
        assert stored(out / f"denoised{number}.exr") == "half"
        expected = denoiser(sequence.frame(number))[0].permute(1, 2, 0).numpy()
        np.testing.assert_allclose(pixels, expected, rtol=2**-11, atol=1e-6)


def test_full_floats_and_a_denoiser_that_was_used_before(small_sequence: Path, tmp_path: Path) -> None:
    sequence, denoiser = open_sequence(small_sequence, "1"), Denoiser(small_model())
    denoiser(open_sequence(small_sequence).frame(0))
    denoise_sequence(sequence, tmp_path / "out", denoiser, "small", half=False)
    assert stored(tmp_path / "out" / "denoised1.exr") == "float"
    denoiser.reset()
    expected = denoiser(sequence.frame(1))[0].permute(1, 2, 0).numpy()
    assert np.array_equal(read_exr(tmp_path / "out" / "denoised1.exr")[0], expected)


def test_the_report_of_a_sequence(small_sequence: Path, tmp_path: Path) -> None:
    sequence = open_sequence(small_sequence)
    report = denoise_sequence(sequence, tmp_path / "out", Denoiser(small_model()), "small")
    written = json.loads((tmp_path / "out" / "denoise.json").read_text())
    assert written["model"] == "small"
    assert set(written["versions"]) == {"mcdenoise", "torch", "kornia"}
    assert written["device"] == "cpu"
    assert written["precision"] == "float32"
    assert written["threads"] == torch.get_num_threads()
    assert written["sequence"] == {"name": "plane", "layout": "bmfr", "size": [20, 24]}
    assert (written["keep_all"], written["tolerance"]) == (False, 1e-3)
    assert written["plan"] == report.plan
    assert [(row["stage"], row["kept"], row["left_out"], row["reason"]) for row in report.plan] == [
        ("read", True, 0, "color is stored with albedo"),
        ("accumulate", True, 0, "positions and cameras"),
        ("reproject", True, 0, "positions and cameras"),
        ("remember", True, 0.25, "last frame"),
        ("demodulate", True, 0, "albedo"),
        ("normal weights", True, 0, "normal"),
        ("depth weights", True, 0, "depth"),
        ("noise-free pixels", True, 0, "there are none"),
        ("network", True, 0, "on 100% of the pixels"),
    ]
    assert all(row["exact"] for row in report.plan)
    assert list(written["frames"]) == ["0", "1", "2", "3"]
    for number, frame in written["frames"].items():
        assert list(frame["milliseconds"]) == ["waiting", *STAGES]
        assert list(frame["beside"]) == ["read", "write"]
        assert all(value >= 0 for times in (frame["milliseconds"], frame["beside"]) for value in times.values())
        assert frame["reset"] == ("first frame" if number == "0" else "")
        assert (frame["replaced_pixels"], frame["missing"]) == (0, [])
    assert written["milliseconds"] == report.milliseconds
    network = sorted(report.frames[number].milliseconds["network"] for number in (1, 2, 3))
    assert report.milliseconds["network"] == network[1]


def test_the_plan_of_color_alone(small_sequence: Path, tmp_path: Path) -> None:
    for path in (small_sequence / "inputs").iterdir():
        if not path.name.startswith("color"):
            path.unlink()
    report = denoise_sequence(open_sequence(small_sequence), tmp_path / "out", Denoiser(small_model()), "small")
    assert {row["stage"]: row["reason"] for row in report.plan if not row["kept"]} == {
        "accumulate": "no motion, and no positions with cameras: single frames",
        "reproject": "no motion, and no positions with cameras: single frames",
        "remember": "no motion, and no positions with cameras: single frames",
        "demodulate": "no albedo",
        "normal weights": "no normal",
        "depth weights": "no depth",
    }
    assert report.frames[3].missing == ["albedo", "normal", "depth"]
    assert report.frames[3].reset.startswith("no motion")


def test_a_bad_frame_is_named_and_leaves_only_whole_files(small_sequence: Path, tmp_path: Path) -> None:
    path = small_sequence / "inputs" / "shading_normal2.exr"
    pixels = read_exr(path)[0]
    pixels[4, 5] = np.nan
    write_exr(path, pixels, ["R", "G", "B"])
    sequence, out = open_sequence(small_sequence), tmp_path / "out"
    message = refused(lambda: denoise_sequence(sequence, out, Denoiser(small_model()), "small"))
    assert f"{small_sequence}, frame 2: buffer 'normal'" in message
    assert sorted(path.name for path in out.iterdir()) == ["denoised0.exr", "denoised1.exr"]


# Reading and writing beside the network


class Slow(nn.Module):
    """A network that changes nothing, and takes its time."""

    def forward(self, color: Tensor, *_: Tensor) -> Denoised:
        time.sleep(DELAY)
        return Denoised(color, color)


DELAY = 0.15


def slowly(monkeypatch: pytest.MonkeyPatch, *, read: float = 0.0, write: float = 0.0) -> None:
    """Let reading a frame and writing one take so many seconds more."""
    frame, write_exr = Sequence.frame, mcdenoise.denoise.write_exr

    def slow_frame(*arguments: Any, **options: Any) -> Frame:
        time.sleep(read)
        return frame(*arguments, **options)

    def slow_write(*arguments: Any, **options: Any) -> None:
        time.sleep(write)
        write_exr(*arguments, **options)

    monkeypatch.setattr(Sequence, "frame", slow_frame)
    monkeypatch.setattr("mcdenoise.denoise.write_exr", slow_write)


def test_reading_and_writing_go_on_while_a_frame_is_denoised(
    small_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slowly(monkeypatch, read=DELAY, write=DELAY)
    sequence, times = open_sequence(small_sequence), []
    for ahead in (True, False):
        denoiser = Denoiser(Slow())
        monkeypatch.setattr(denoiser, "reset", lambda *_, room=ahead, of=denoiser: setattr(of, "has_room_ahead", room))
        start = time.perf_counter()
        report = denoise_sequence(sequence, tmp_path / "out", denoiser, "slow")
        times.append(time.perf_counter() - start)
        written = json.loads((tmp_path / "out" / "denoise.json").read_text())
        assert written["reads_ahead"] is ahead
        for number, done in report.frames.items():
            assert min(done.beside["read"], done.beside["write"]) >= DELAY * 1e3
            assert written["frames"][str(number)]["milliseconds"]["waiting"] == done.milliseconds["waiting"]
        waiting = [done.milliseconds["waiting"] for done in report.frames.values()]
        # All of reading and writing, or else reading the first frame and what a busy machine adds.
        assert (sum(waiting[1:]) < 3 * DELAY * 1e3) is ahead
        assert waiting[0] >= DELAY * 1e3
    # One after the other, four frames take twelve delays; side by side, six.
    assert times[1] >= 12 * DELAY
    assert times[0] < 0.8 * times[1]


def test_reading_ahead_does_not_change_an_image(
    small_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sequence = open_sequence(small_sequence)
    for name, ahead in (("ahead", True), ("alone", False)):
        denoiser = Denoiser(small_model())
        monkeypatch.setattr(type(denoiser._memory), "has_room_ahead", lambda *_, room=ahead: room)
        denoise_sequence(sequence, tmp_path / name, denoiser, "small", half=False)
        assert denoiser.has_room_ahead is ahead
    for number in sequence.numbers:
        images = [read_exr(tmp_path / name / f"denoised{number}.exr")[0] for name in ("ahead", "alone")]
        assert np.array_equal(*images)


def test_no_more_than_one_frame_is_read_ahead(
    small_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[int] = []
    frame = Sequence.frame
    monkeypatch.setattr(Sequence, "frame", lambda self, number, **_: read.append(number) or frame(self, number))
    model = Slow()
    seen: list[int] = []
    model.register_forward_hook(lambda *_: seen.append(len(read)))
    denoise_sequence(open_sequence(small_sequence), tmp_path / "out", Denoiser(model), "slow")
    assert seen == [2, 3, 4, 4]


@pytest.mark.parametrize("failing", [0, 1, 3])
def test_a_frame_that_cannot_be_written_ends_the_run(
    small_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: int
) -> None:
    out = tmp_path / "out"
    (out / f"denoised{failing}.exr").mkdir(parents=True)
    sequence = open_sequence(small_sequence)
    message = refused(lambda: denoise_sequence(sequence, out, Denoiser(small_model()), "small"))
    assert f"denoised{failing}.exr: expected a file to write" in message
    whole = sorted(path.name for path in out.iterdir() if path.is_file())
    assert whole == [f"denoised{number}.exr" for number in range(failing)]


def test_an_interrupt_leaves_only_whole_files(
    small_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slowly(monkeypatch, write=DELAY)
    out, done = tmp_path / "out", []
    # What an earlier test of this process has left running is not of this run.
    running = set(threading.enumerate())

    def interrupt() -> None:
        done.append(len(done))
        if len(done) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        denoise_sequence(open_sequence(small_sequence), out, Denoiser(small_model()), "small", on_frame=interrupt)
    # What was being written is finished.
    assert sorted(path.name for path in out.iterdir()) == ["denoised0.exr", "denoised1.exr"]
    for number in range(2):
        assert read_exr(out / f"denoised{number}.exr")[0].shape == (20, 24, 3)
    started = set(threading.enumerate()) - running
    assert not [thread for thread in started if thread.name.startswith("ThreadPoolExecutor")]


def test_an_output_folder_that_cannot_be(small_sequence: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    sequence, denoiser = open_sequence(small_sequence), Denoiser(small_model())
    for out in (tmp_path / "file", tmp_path / "file" / "below"):
        message = refused(lambda out=out: denoise_sequence(sequence, out, denoiser, "small"))
        assert f"{out}: expected a folder that can be written to" in message


def test_an_old_report_does_not_survive_a_run_that_fails(small_sequence: Path, tmp_path: Path) -> None:
    sequence, out = open_sequence(small_sequence), tmp_path / "out"
    denoise_sequence(sequence, out, Denoiser(small_model()), "small")
    path = small_sequence / "inputs" / "albedo2.exr"
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(InputError):
        denoise_sequence(sequence, out, Denoiser(small_model()), "small")
    assert not (out / "denoise.json").exists()


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
