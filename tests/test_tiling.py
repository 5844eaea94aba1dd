"""Large frames on the command line and from files: in tiles, within a limit of memory."""

import json
import sys
from pathlib import Path

import pytest
import torch
from planes import synthetic
from refusals import refused
from toys import small

from mcdenoise import Denoiser
from mcdenoise.benchmark.memory import output_and_peak
from mcdenoise.data import open_sequence
from mcdenoise.data.readers.bmfr import write_bmfr_frame
from mcdenoise.folder import denoise_sequence


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    for number in range(2):
        write_bmfr_frame(tmp_path / "floor" / "inputs", number, synthetic(160, 96, number).replace(motion=None))
    return tmp_path / "floor"


def test_the_command_line_says_the_tiles_and_why(sequence: Path, weights: Path, tmp_path: Path) -> None:
    printed, _ = output_and_peak("denoise", sequence, "-o", tmp_path / "out", "--weights", weights, "--tile", "64")
    assert "  tiles: 3 x 2 tiles of up to 64x64 pixels: as asked for" in printed
    report = json.loads((tmp_path / "out" / "denoise.json").read_text())
    assert report["tiles"] == "3 x 2 tiles of up to 64x64 pixels: as asked for"
    assert report["reads_ahead"] is True


def test_memory_that_is_too_short_is_told_before_a_frame_is_read(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = open_sequence(sequence)
    monkeypatch.setattr(type(opened), "frame", lambda *_, **__: pytest.fail("a frame was read"))
    denoiser = Denoiser(small("cascaded"), max_memory=0.1)
    message = refused(lambda: denoise_sequence(opened, tmp_path / "out", denoiser, "small"))
    assert message.startswith("max_memory: expected at least")
    assert list((tmp_path / "out").iterdir()) == []


# Measured on one core: 3.27 GB of the first, 1.49 GB of the last.
@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.skipif(sys.platform != "linux", reason="the peak of memory as Linux tells it")
@pytest.mark.parametrize(
    ("model", "precision", "width", "height", "limit"),
    [("wild", "bfloat16", 7680, 4320, 4.0), ("wild", "float32", 3840, 2160, 2.0)],
)
def test_the_peak_of_memory_stays_below_the_limit(
    model: str, precision: str, width: int, height: int, limit: float, tmp_path: Path
) -> None:
    frame = synthetic(width, height).replace(motion=None)
    write_bmfr_frame(tmp_path / "large" / "inputs", 0, frame.replace(position=torch.rand_like(frame.color)))
    options = ("--model", model, "--precision", precision, "--max-memory", str(limit))
    printed, peak = output_and_peak("denoise", tmp_path / "large", "-o", tmp_path / "out", *options)
    print(f"{model}, {precision}, {width}x{height}: {peak:.2f} GB\n{printed}")
    assert 0.6 * limit < peak < limit
