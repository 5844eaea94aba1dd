"""Denoising of a folder of frames into a folder of clean ones: what is written, what is told, and what runs beside."""

import json
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pictures import channels_of
from refusals import refused
from torch import Tensor, nn
from toys import small

from mcdenoise import Denoiser, Frame
from mcdenoise.data import Sequence, open_sequence, read_exr, write_exr
from mcdenoise.folder import denoise_sequence

STAGES = ["validate", "accumulate", "plan", "network", "wild_small"]


def test_a_sequence_is_written_with_its_numbers_and_metadata(small_sequence: Path, tmp_path: Path) -> None:
    sequence, out = open_sequence(small_sequence, "1-2"), tmp_path / "deep" / "out"
    for number in sequence.numbers:
        color = small_sequence / "inputs" / f"color{number}.exr"
        write_exr(color, read_exr(color)[0], ["R", "G", "B"], metadata={"Owner": f"frame {number}", "camera": 1.5})
    denoise_sequence(sequence, out, Denoiser(small("cascaded")), "small")
    assert sorted(path.name for path in out.iterdir()) == ["denoise.json", "denoised1.exr", "denoised2.exr"]
    denoiser = Denoiser(small("cascaded"))
    for number in sequence.numbers:
        pixels, channels, metadata = read_exr(out / f"denoised{number}.exr")
        assert channels == ["R", "G", "B"]
        assert (metadata["Owner"], metadata["camera"]) == (f"frame {number}", 1.5)
        assert channels_of(out / f"denoised{number}.exr")["R"].dtype == np.float16
        expected = denoiser(sequence.frame(number))[0].permute(1, 2, 0).numpy()
        np.testing.assert_allclose(pixels, expected, rtol=2**-11, atol=1e-6)


def test_the_report_of_a_sequence(small_sequence: Path, tmp_path: Path) -> None:
    sequence = open_sequence(small_sequence)
    denoiser = Denoiser("wild_small")
    report = denoise_sequence(sequence, tmp_path / "out", denoiser, "small")
    written = json.loads((tmp_path / "out" / "denoise.json").read_text())
    assert written["model"] == "small"
    assert set(written["versions"]) == {"mcdenoise", "torch", "kornia"}
    assert written["device"] == "cpu"
    assert written["precision"] == "float32"
    assert written["threads"] == torch.get_num_threads()
    assert written["sequence"] == {"name": "plane", "layout": "bmfr", "size": [20, 24]}
    assert (written["keep_all"], written["tolerance"]) == (False, 1e-3)
    assert written["plan"] == report.plan
    assert [(row["stage"], row["kept"], row["skipped"], row["reason"]) for row in report.plan] == [
        ("read", True, 0, "color is stored with albedo"),
        ("demodulate", True, 0, "albedo"),
        ("accumulate", True, 0, "positions and cameras"),
        ("reproject", True, 0, "positions and cameras"),
        ("remember", True, 0.25, "last frame"),
        ("noise-free pixels", True, 0, "there are none"),
        ("converged tiles", True, 0, "there are none"),
        ("unchanged tiles", True, 0, "there are none"),
        ("network", True, 0, "on 100% of the pixels"),
    ]
    assert {row["stage"] for row in report.plan if not row["exact"]} == {"converged tiles", "unchanged tiles"}
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


class Slow(nn.Module):
    def forward(self, color: Tensor) -> Tensor:
        time.sleep(DELAY)
        return color


DELAY = 0.15


def slowly(monkeypatch: pytest.MonkeyPatch, *, read: float = 0.0, write: float = 0.0) -> None:
    frame, write_frame = Sequence.frame, Sequence.write

    def slow_frame(*arguments: Any, **options: Any) -> Frame:
        time.sleep(read)
        return frame(*arguments, **options)

    def slow_write(*arguments: Any, **options: Any) -> Path:
        time.sleep(write)
        return write_frame(*arguments, **options)

    monkeypatch.setattr(Sequence, "frame", slow_frame)
    monkeypatch.setattr(Sequence, "write", slow_write)


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
        denoiser = Denoiser(small("cascaded"))
        monkeypatch.setattr(type(denoiser._tiles), "has_room_ahead", lambda *_, room=ahead: room)
        denoise_sequence(sequence, tmp_path / name, denoiser, "small", full_float=True)
        assert denoiser.has_room_ahead is ahead
    for number in sequence.numbers:
        images = [read_exr(tmp_path / name / f"denoised{number}.exr")[0] for name in ("ahead", "alone")]
        assert np.array_equal(*images)


@pytest.mark.parametrize("failing", [0, 3])
def test_a_frame_that_cannot_be_written_ends_the_run(
    small_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: int
) -> None:
    out = tmp_path / "out"
    (out / f"denoised{failing}.exr").mkdir(parents=True)
    sequence = open_sequence(small_sequence)
    message = refused(lambda: denoise_sequence(sequence, out, Denoiser(small("cascaded")), "small"))
    assert f"denoised{failing}.exr: expected a file to write" in message
    whole = sorted(path.name for path in out.iterdir() if path.is_file())
    assert whole == [f"denoised{number}.exr" for number in range(failing)]


def test_an_interrupt_leaves_only_whole_files(
    small_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slowly(monkeypatch, write=DELAY)
    out, done = tmp_path / "out", []
    # A thread that an earlier test of this process has left running does not belong to this run.
    running = set(threading.enumerate())

    def interrupt() -> None:
        done.append(len(done))
        if len(done) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        denoise_sequence(open_sequence(small_sequence), out, Denoiser(small("cascaded")), "small", on_frame=interrupt)
    assert sorted(path.name for path in out.iterdir()) == ["denoised0.exr", "denoised1.exr"]
    for number in range(2):
        assert read_exr(out / f"denoised{number}.exr")[0].shape == (20, 24, 3)
    started = set(threading.enumerate()) - running
    assert not [thread for thread in started if thread.name.startswith("ThreadPoolExecutor")]


def test_an_old_report_does_not_survive_a_run_that_fails(small_sequence: Path, tmp_path: Path) -> None:
    sequence, out = open_sequence(small_sequence), tmp_path / "out"
    denoise_sequence(sequence, out, Denoiser(small("cascaded")), "small")
    path = small_sequence / "inputs" / "albedo2.exr"
    path.write_bytes(path.read_bytes()[:-40])
    refused(denoise_sequence, sequence, out, Denoiser(small("cascaded")), "small")
    assert not (out / "denoise.json").exists()


@pytest.mark.parametrize(
    ("name", "target"),
    [("denoised3.exr", "color0.exr"), ("denoise.json", "camera_matrices.h"), ("preview", "."), ("preview.mp4", ".")],
)
def test_an_output_that_is_a_link_to_an_input_is_refused(
    small_sequence: Path, tmp_path: Path, name: str, target: str
) -> None:
    """Links are followed where something is written, so that this would replace the input."""
    inputs, out = small_sequence / "inputs", tmp_path / "out"
    out.mkdir()
    (out / name).symlink_to(inputs / target)
    before = {path.name: path.read_bytes() for path in inputs.iterdir()}
    assert "a link to an input" in refused(
        lambda: denoise_sequence(open_sequence(small_sequence), out, Denoiser("noisy"), "noisy")
    )
    assert {path.name: path.read_bytes() for path in inputs.iterdir()} == before
    assert [path.name for path in out.iterdir()] == [name]


@pytest.mark.parametrize(
    ("elsewhere", "expected"),
    [("there.exr", "a link to an input"), ("out/denoised2.exr", "denoised2.exr: expected no input")],
)
def test_an_output_that_is_what_an_input_links_to_is_refused(
    small_sequence: Path, tmp_path: Path, elsewhere: str, expected: str
) -> None:
    """By a link of its own, or since it has the name of a result: it would be replaced."""
    color, out, real = small_sequence / "inputs" / "color2.exr", tmp_path / "out", tmp_path / elsewhere
    out.mkdir()
    color.rename(real)
    for link in {color, out / "denoised2.exr"} - {real}:
        link.symlink_to(real)
    assert expected in refused(denoise_sequence, open_sequence(small_sequence), out, Denoiser("noisy"), "noisy")


def test_files_of_an_earlier_longer_run_are_kept_and_named(small_sequence: Path, tmp_path: Path) -> None:
    """They may be other frames of the same shot: it is for their owner to remove them."""
    out = tmp_path / "out"
    denoise_sequence(open_sequence(small_sequence), out, Denoiser("noisy"), "noisy")
    report = denoise_sequence(open_sequence(small_sequence, "1-2"), out, Denoiser("noisy"), "noisy")
    assert report.older == ["denoised0.exr", "denoised3.exr"]
    (warning,) = report.warnings
    assert "2 files of an earlier run (denoised0.exr, denoised3.exr) remain" in warning
    assert warning in json.loads((out / "denoise.json").read_text())["warnings"]
    assert len(list(out.glob("*.exr"))) == 4
    assert not denoise_sequence(open_sequence(small_sequence), out, Denoiser("noisy"), "noisy").warnings
