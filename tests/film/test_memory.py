"""Ten thousand frames through one process: memory stays what it is."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
from shots import write_shot

from mcdenoise.film import work
from mcdenoise.film.manifest import Shot
from mcdenoise.film.pieces import cut
from mcdenoise.film.record import FrameRecord, Journal, read_records
from mcdenoise.film.work import Order, make, scan
from mcdenoise.shot import ShotSettings

FRAMES, DIFFERENT = 10_000, 50


def resident() -> int:
    """Bytes of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="memory is told by /proc")
def test_memory_is_flat_over_thousands_of_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inputs = write_shot(tmp_path / "shot", DIFFERENT, width=64, height=40) / "inputs"
    (inputs / "camera_matrices.h").unlink()
    for number in range(DIFFERENT, FRAMES):
        for name in ("color", "albedo", "shading_normal"):
            os.link(inputs / f"{name}{number % DIFFERENT}.exr", inputs / f"{name}{number}.exr")
    for path in inputs.glob("world_position*.exr"):
        path.unlink()
    for path in inputs.glob("depth*.exr"):
        path.unlink()
    measured: dict[int, int] = {}
    add = Journal.add

    def watched(self: Journal, record: FrameRecord) -> Any:
        if record.number in (FRAMES // 5, FRAMES - 1):
            measured[record.number] = resident()
        add(self, record)

    monkeypatch.setattr(Journal, "add", watched)
    order = Order(Shot("long", (inputs,), ShotSettings("guided")), tmp_path / "out", 0.01, 1)
    found = scan(order)
    assert len(found.numbers) == FRAMES
    (piece,) = cut(found.numbers, found.numbers, 0, found.overlap)
    assert not make(order, piece)
    assert len(read_records(order.records)) == FRAMES
    early, late = measured.values()
    print(f"{early / 1e6:.1f} MB after {FRAMES // 5} frames, {late / 1e6:.1f} MB after {FRAMES}")
    assert late < 1.01 * early
    work.open_order.cache_clear()
