"""Histories in files: the same images, within the memory that was promised."""

from __future__ import annotations

import errno
import gc
import json
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from mcdenoise import Denoiser, Frame
from mcdenoise.benchmark.memory import output_and_peak
from mcdenoise.data import open_sequence
from mcdenoise.data.readers.bmfr import write_bmfr_frame
from mcdenoise.errors import InputError
from mcdenoise.metrics import smape_linear
from mcdenoise.models import _memory, _spilled, _windows, parts_of
from mcdenoise.models._memory import GB, Frames, Memory, Network
from mcdenoise.models._spilled import empty_spilled, is_spilled, spilled
from mcdenoise.models.accumulated import Accumulated
from mcdenoise.ops import Surface
from mcdenoise.ops._steps.history import blend, incoming, without_history

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="pages are dropped as Linux does it")


@pytest.fixture(autouse=True)
def _of_any_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small tensors go into files, too, and windows have some rows."""
    monkeypatch.setattr(_spilled, "_LEAST", 64)
    monkeypatch.setattr(_windows, "_PIXELS", 256)


def test_a_tensor_in_a_file_is_the_same_and_goes_with_its_last_view() -> None:
    image = torch.rand(1, 3, 20, 32)
    stored = spilled(image)
    assert torch.equal(stored, image)
    assert is_spilled(stored[:, 1:])
    assert not is_spilled(image)
    assert spilled(stored) is stored
    before = len(_spilled._mapped)
    view = stored[..., 3:, :]
    del stored
    gc.collect()
    assert len(_spilled._mapped) == before
    del view
    gc.collect()
    assert len(_spilled._mapped) == before - 1


def test_no_room_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(InputError, match=r"room for a history .* \(No space left on device\).* by TMPDIR"):
        empty_spilled((1, 3, 20, 32), torch.float32)


@pytest.mark.parametrize(
    "shift", [lambda y: 0 * y, lambda y: y / 3 - 5, lambda y: 17 + 0 * y, lambda y: 1e6 * (y - 20)]
)
def test_windows_hold_all_that_motion_leads_to(shift: Callable[[torch.Tensor], torch.Tensor]) -> None:
    generator = torch.Generator().manual_seed(0)
    height, width = 41, 32
    color, before = torch.rand(2, 1, 3, height, width, generator=generator).unbind(0)
    previous = without_history(incoming(before))
    motion = torch.rand(1, 2, height, width, generator=generator)
    motion[:, 1] += shift(torch.arange(height).float())[:, None]
    depth = torch.ones(1, 1, height, width)
    surface = Surface(None, None, depth, None)
    arguments = (incoming(color), previous, torch.full((1, 1, height, width), 3.0), motion, surface, surface)
    whole = blend(*arguments, lag_threshold=2.0, specular_length=2.0, albedo=color)
    windows = _windows.blend_in_windows(*arguments, lag_threshold=2.0, specular_length=2.0, albedo=color)
    # The place of a tap is rounded where rows are counted from another one: by 2^-18 of a pixel in 64 rows.
    for one, other in zip(whole, windows, strict=True):
        assert torch.allclose(one, other, rtol=1e-4, atol=1e-4)


def test_the_images_are_those_of_a_history_in_memory(small_sequence: Path) -> None:
    opened = open_sequence(small_sequence)
    images = []
    for spills in (False, True):
        denoiser = Denoiser("cascaded_v2_micro", precision="float32", keep_all=True)
        denoiser._tiles._accumulated = []
        for each in parts_of(denoiser.model, Accumulated):
            each.spill(spills)
        frames = [opened.frame(number, reference=False) for number in opened.numbers]
        images.append([denoiser(frame.map(spilled) if spills else frame) for frame in frames])
        assert denoiser.report.reset == ""
    for one, other in zip(*images, strict=True):
        assert float(smape_linear(one, other)) < 1e-5


def test_a_sequence_of_8k_is_promised_within_4_gb(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_memory, "_memory_in_use", lambda device: 0.95 * GB)
    buffers = frozenset({"color", "albedo", "normal", "depth", "position"})
    frames, network = Frames((4320, 7680), buffers, streaming=True), Network(128, 700)
    memory = Memory(4 * GB, torch.device("cpu"))
    assert memory.is_short(frames, network)
    assert not memory.is_short(frames._replace(spilled=True), network)
    assert memory.choose(frames._replace(spilled=True), network).side is not None


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_sequence_of_8k_within_4_gb(small_sequence: Path, tmp_path: Path) -> None:
    """Frames of a small sequence, 7680x4320: larger pixels, and the positions in between."""
    opened, inputs = open_sequence(small_sequence), tmp_path / "large/inputs"
    size = (4320, 7680)
    for number in opened.numbers[:3]:
        frame = opened.frame(number, reference=False)
        large = {name: F.interpolate(image, size, mode="nearest") for name, image in frame.items() if image.ndim == 4}
        assert frame.position is not None
        large["position"] = F.interpolate(frame.position, size, mode="bilinear")
        kept = ("color", "albedo", "normal", "position")
        write_bmfr_frame(inputs, number, Frame(**{name: large[name] for name in kept}))
    shutil.copy(small_sequence / "inputs/camera_matrices.h", inputs)
    settings = ("--model", "cascaded_v2_micro", "--precision", "float32", "--max-memory", "4")
    _, peak = output_and_peak("denoise", tmp_path / "large", "-o", tmp_path / "out", *settings)
    report = json.loads((tmp_path / "out/denoise.json").read_text())
    assert report["tiles"].endswith("the history is in a file")
    assert np.mean([each["history"] for each in list(report["frames"].values())[1:]]) > 0.5
    assert peak < 4
