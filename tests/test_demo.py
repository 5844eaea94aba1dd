import importlib

import numpy as np
import pytest
from commands import succeeds

from mcdenoise.data import open_sequence, read_exr
from mcdenoise.evaluate import evaluate_folder
from mcdenoise.results import Results

pytest.importorskip("mitsuba", reason="the demo renders with Mitsuba, which is not installed")


@pytest.fixture
def small_demo(monkeypatch):
    demo = importlib.import_module("mcdenoise.cli.demo")
    monkeypatch.setattr(demo, "FRAMES", 3)
    monkeypatch.setattr(demo, "SIZE", (64, 36))
    monkeypatch.setattr(demo, "REFERENCE_SPP", 64)
    monkeypatch.setattr(demo, "REFERENCE_FRAMES", (1, 2))
    return demo


def test_demo_renders_denoises_and_shows(small_demo, tmp_path, monkeypatch):
    bars = []
    monkeypatch.setattr(small_demo, "progress_bar", lambda bar=small_demo.progress_bar: bars.append(bar()) or bars[-1])
    printed = succeeds("demo", "-o", tmp_path)
    rendering, denoising, comparing = bars[0].tasks
    assert rendering.completed == rendering.total == 3 + 2 * 64
    assert denoising.completed == denoising.total == 3
    assert comparing.completed == comparing.total
    found = Results.read(tmp_path / "report")
    smape = {cell.method: cell.errors["SMAPE"] for cell in found.cells if cell.errors}
    assert all(name in printed for name in smape)
    assert smape["wild"] < smape["accumulated"] < smape["noisy"]
    clean = tmp_path / "denoised"
    names = sorted(path.name for path in clean.iterdir())
    assert names == ["denoise.json", "denoised0.exr", "denoised1.exr", "denoised2.exr"]
    page = tmp_path / "report" / "index.html"
    assert (found.scenes[0].scored, found.scenes[0].pictures, found.failed) == ([1, 2], [0, 1, 2], False)
    assert "demo" in found.command
    # The errors are those of the files that were written, up to their half precision.
    written = evaluate_folder(open_sequence(tmp_path / "sequence"), clean).tables["strict"]
    assert smape["wild"] == pytest.approx(written.mean["SMAPE"], rel=1e-3)
    sheet = (tmp_path / "demo.png").read_bytes()
    assert sheet.startswith(b"\x89PNG")

    # Existing files are used again: the noise, and with it every clean frame, stays the same to the last bit.
    before = read_exr(clean / "denoised2.exr")[0]
    files = {path: path.stat().st_mtime_ns for path in (tmp_path / "sequence" / "inputs").glob("*.exr")}
    assert len(files) == 3 * 5 + 2
    report = page.stat().st_mtime_ns
    monkeypatch.setattr(small_demo, "COMPARED", "none")
    succeeds("demo", "-o", tmp_path)
    assert page.stat().st_mtime_ns > report
    assert {path: path.stat().st_mtime_ns for path in files} == files
    np.testing.assert_array_equal(read_exr(clean / "denoised2.exr")[0], before)
    assert open_sequence(tmp_path / "sequence").reference_numbers == [1, 2]
