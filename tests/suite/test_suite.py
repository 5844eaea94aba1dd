"""The suite: its rows, its rendering at tiny sizes, and its tables. Tests that need a renderer are skipped without."""

import dataclasses
import os
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import refuses, succeeds
from refusals import refused

from mcdenoise.data import read_exr, write_exr
from mcdenoise.data.png import read_png
from mcdenoise.results import Cell, Machine, Method, Results, Scene, Spread
from mcdenoise.suite import rendering
from mcdenoise.suite.close_ups import PARTS, write_close_ups
from mcdenoise.suite.rendering import open_row, render_suite, rows_there
from mcdenoise.suite.rows import Row, Shot, choose_rows
from mcdenoise.suite.tables import PSNR, SMAPE, TEMPORAL, error_against_time, lines_of, markdown, verdict

BLENDER = os.environ.get("BLENDER_PYTHON")
TINY: dict[str, Any] = {"frames": 2, "size": (16, 9), "reference_samples": 8}


def test_rows_are_chosen_by_patterns() -> None:
    names = [row.name for row in choose_rows("cycles-gallery-4*, mitsuba-parlour-lens-4")]
    assert names == ["cycles-gallery-4", "cycles-gallery-4-still", "mitsuba-parlour-lens-4"]
    assert re.search(r"--rows: .*'gallery'", refused(choose_rows, "cycles-*,gallery"))


@pytest.fixture
def two_shots(monkeypatch: pytest.MonkeyPatch) -> list[Shot]:
    shots = [Shot(f"tiny-{n}", "mitsuba", "parlour", n, "box", **TINY) for n in (1, 2)]
    monkeypatch.setattr(rendering, "SHOTS", tuple(shots))
    return shots


@pytest.mark.slow
def test_rendering_resumes_and_shares_references(tmp_path: Path, two_shots: list[Shot]) -> None:
    mitsuba = pytest.importorskip("mitsuba", reason="rendering needs Mitsuba: pip install 'mcdenoise[render]'")
    # Rendering so small an image takes less time than compiling a kernel.
    mitsuba.set_variant("scalar_rgb")
    steps: list[tuple[Any, ...]] = []
    render_suite(two_shots, tmp_path, on_step=lambda *step: steps.append(step))
    assert [(shot, fraction) for shot, fraction, *_ in steps] == [
        (shot.name, fraction) for fraction in (0.25, 1.0) for shot in two_shots
    ]
    rows = [Row(shot, still) for shot in two_shots for still in (False, True)]
    assert rows_there(rows, tmp_path) == rows
    first, still, second, _ = (open_row(row, tmp_path) for row in rows)
    assert (first.name, first.numbers, first.reference_numbers) == ("tiny-1", [0, 1], [1])
    assert (still.name, still.numbers) == ("tiny-1-still", [1])
    assert first.frame(1).reference.equal(second.frame(1).reference)
    assert not first.frame(1).color.equal(second.frame(1).color)
    header = read_exr(tmp_path / "tiny-2" / "inputs" / "reference1.exr")[2]
    assert header["reference_spp"] == 8
    (tmp_path / "tiny-2" / "inputs" / "color1.exr").unlink()
    assert rows_there(rows, tmp_path) == rows[:2]
    kept = (tmp_path / "tiny-1" / "inputs" / "color1.exr").stat().st_mtime_ns
    render_suite(two_shots, tmp_path)
    assert rows_there(rows, tmp_path) == rows
    assert (tmp_path / "tiny-1" / "inputs" / "color1.exr").stat().st_mtime_ns == kept


def test_cycles_needs_a_blender(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shot = Shot("tiny", "cycles", "attic", 1, "default", **TINY)
    monkeypatch.setenv("BLENDER_PYTHON", str(tmp_path / "nowhere"))
    assert "nowhere:" in refused(render_suite, [shot], tmp_path / "data")
    assert not (tmp_path / "data").exists()
    # This Python has the module, but cannot render.
    broken = tmp_path / "broken.sh"
    broken.write_text("#!/bin/sh\necho '{\"ok\": \"4.5\"}'; read line && echo 'no light' >&2; exit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("BLENDER_PYTHON", str(broken))
    assert "no light" in refused(render_suite, [shot], tmp_path / "data")
    assert rows_there([Row(shot, True)], tmp_path / "data") == []


@pytest.mark.slow
@pytest.mark.skipif(BLENDER is None, reason="no BLENDER_PYTHON: an interpreter with bpy")
@pytest.mark.parametrize("scene", ["gallery", "garden", "attic"])
def test_the_reader_reads_files_of_cycles(tmp_path: Path, scene: str) -> None:
    shot = Shot(f"tiny-{scene}", "cycles", scene, 1, "default", **TINY)
    render_suite([shot], tmp_path, threads=1)
    sequence = open_row(Row(shot, False), tmp_path)
    assert sequence.size == (9, 16)
    assert {"albedo", "normal", "depth", "motion", "reference"} <= sequence.buffers | {"reference"}
    assert sequence.reference_numbers == [1]
    frame = sequence.frame(1)
    assert float(frame.reference.mean()) == pytest.approx(float(frame.color.mean()), rel=0.5)


def test_a_reference_is_the_mean_of_its_parts_with_an_estimate_of_its_noise(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    parts = []
    for part in range(8):
        pixels = (1 + 0.1 * rng.standard_normal((40, 50, 3))).astype(np.float32)
        parts.append(tmp_path / f"{part}.exr")
        write_exr(parts[-1], pixels, ["R", "G", "B"])
    noise = rendering._write_reference(tmp_path / "reference.exr", parts, 4)
    mean = np.mean([read_exr(path)[0] for path in parts], axis=0)
    np.testing.assert_allclose(read_exr(tmp_path / "reference.exr")[0], mean, rtol=1e-3)
    # A Gaussian has E|x| = sigma sqrt(2 / pi), here divided by 2 + 0.01; 6000 values estimate it to 1 %.
    assert noise == pytest.approx(0.1 / 8**0.5 * (2 / np.pi) ** 0.5 / 2.01, rel=0.05)


def _results(ours: list[float], fast: list[float], high: list[float]) -> tuple[Results, list[Row]]:
    """SMAPE of a model and of two settings of OIDN on rows ``a``, ``b``, ...; PSNR is 100 times its complement."""
    rows = [
        Row(Shot(name, "mitsuba", "parlour", 4, "box", frames=1), True) for name, _ in zip("abc", ours, strict=False)
    ]
    methods = [
        Method("noisy", "baseline", "noisy", "noisy"),
        Method("ours", "trainable", "ours", "wild"),
        Method("oidn(quality=fast)", "fixed", "fast", "oidn", {"quality": "fast"}),
        Method("oidn(quality=high)", "fixed", "high", "oidn", {"quality": "high"}),
    ]
    scenes = [Scene(row.name, 32, 18, [0], [0], [0], 0.01) for row in rows]
    cells = [
        Cell(row.name, method.name, {SMAPE: values[i], PSNR: 100 * (1 - values[i])}, computing=Spread(7.0, 7, 7, 1))
        for method, values in zip(methods, ([0.5] * len(rows), ours, fast, high), strict=True)
        for i, row in enumerate(rows)
    ]
    machine = Machine("a processor", 2, 7.8, "cpu", 2, "Linux")
    return Results("", "2026-10-21T12:00:00+00:00", machine, 1, scenes, methods, cells), rows


def test_each_row_is_compared_with_the_best_setting_on_that_row() -> None:
    results, rows = _results([0.1, 0.2], fast=[0.2, 0.15], high=[0.3, 0.1])
    first, second = lines_of(results, rows)
    assert (first.row, first.model, first.samples, first.reference_noise) == ("a", "ours", 4, 0.01)
    assert (first.best[SMAPE].value, first.best[SMAPE].setting) == (0.2, "oidn(quality=fast)")
    assert (second.best[SMAPE].value, second.best[SMAPE].setting) == (0.1, "oidn(quality=high)")
    assert first.best[PSNR].value == pytest.approx(80)
    assert first.ahead(SMAPE)
    assert first.ahead(PSNR)
    assert not second.ahead(SMAPE)
    assert TEMPORAL not in first.best
    summary = verdict([first, second])
    assert summary[0] == "SMAPE: ahead of OIDN's best setting in 1 of 2 rows; behind in b"
    # The geometric mean of 1/2 and 2 is 1, which favours neither.
    assert summary[2] == "SMAPE relative to OIDN's best setting, geometric mean over 2 rows: 1.000"
    text = markdown([first, second], [])
    assert "| a | 0.1000 | 0.2000 | 0.500 | 90.00 | 80.00 |  |  | 7 | 7 | (quality=fast) | 0.0100 |" in text


def test_error_against_time_uses_common_rows_and_names_the_faster_method() -> None:
    results, rows = _results([0.1, 0.2, 0.05], [0.2, 0.2, 0.1], [0.1, 0.4, 0.1])
    times = {"noisy": 1.0, "ours": 10.0, "oidn(quality=fast)": 5.0, "oidn(quality=high)": 40.0}
    results.cells[:] = [
        dataclasses.replace(cell, computing=Spread(times[cell.method], 0, 0, 1))
        for cell in results.cells
        if (cell.scene, cell.method) != ("c", "ours")
    ]
    means, counted = error_against_time(results, rows)
    assert counted == 2
    assert [(each.method, each.milliseconds, each.beaten_by) for each in means] == [
        ("oidn(quality=fast)", pytest.approx(5), ""),
        ("ours", pytest.approx(10), ""),
        ("oidn(quality=high)", pytest.approx(40), "ours"),
    ]
    # Relative to the noisy input's 0.5, the errors are 0.2 and 0.4.
    assert means[1].error == pytest.approx((0.2 * 0.4) ** 0.5)
    assert "| oidn(quality=high) | 0.4000 | 40 | no: ours |" in markdown([], [], means, counted)
    assert error_against_time(results, []) == ([], 0)


def test_close_ups_are_drawn_side_by_side(tmp_path: Path) -> None:
    results, rows = _results([0.1], fast=[0.2], high=[0.3])
    truth = np.full((18, 32, 3), 0.25, np.float32)
    for folder, image in (("noisy", truth * 2), ("ours", truth), ("reference", truth)):
        path = tmp_path / "images" / "a" / folder / "0.exr"
        path.parent.mkdir(parents=True)
        write_exr(path, image, ["R", "G", "B"])
    written = write_close_ups(tmp_path, results, rows, ["noisy", "ours", "oidn(quality=fast)"])
    assert [path.stem for path in written] == list(PARTS["parlour"])
    pixels = read_png(written[0]).astype(int)
    width = (pixels.shape[1] - 2 * 4) // 3
    # Below two lines of text.
    noisy, ours, reference = (pixels[56:, left : left + width] for left in range(0, pixels.shape[1], width + 4))
    np.testing.assert_array_equal(ours, reference)
    assert noisy.min() > reference.max()


def test_the_command_scores_the_existing_rows(
    small_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shot = Shot("small", "mitsuba", "parlour", 1, "centre", frames=4)
    absent = Shot("absent", "mitsuba", "parlour", 1, "centre", frames=1)
    monkeypatch.setattr("mcdenoise.suite.rows.SHOTS", (shot, absent))
    shutil.copytree(small_sequence, tmp_path / "data" / "small")
    out = tmp_path / "out"
    said = succeeds(
        "benchmark",
        *("--suite", "wild", "--data", tmp_path / "data", "--no-render", "-o", out, "--threads", 1),
        *("--models", "wild_small,oidn(quality=fast)", "--json", tmp_path / "suite.json"),
    )
    assert "## wild_small" in said
    assert "not rendered: absent" in said
    text = (out / "suite.md").read_text()
    assert text in said
    lines = [line for line in text.splitlines() if line.startswith("| small")]
    assert [line.split(" | ")[0] for line in lines] == ["| small", "| small-still"]
    assert (out / "suite.json").read_text() == (tmp_path / "suite.json").read_text()
    assert (out / "close-ups" / "small" / "mirror.png").is_file()
    assert (out / "index.html").is_file()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--suite", "wild"), "--data: expected the folder of the suite's frames, found none"),
        (("--suite", "wild", "--data", "data", "--ops"), "--suite: expected neither folders of sequences nor --ops"),
        (("--suite", "wild", "--data", "data", "--no-render"), "--out: expected a folder to write to with --no-render"),
        (("--suite", "wild", "--data", "data", "--rows", "none-such"), "--rows: expected names of rows such as"),
        (("--suite", "wild", "--data", "data", "--models", "nothing"), "nothing"),
        (("--suite", "tame", "--data", "data"), "wild"),
        (("--suite", "wild", "--data", "data", "--no-render", "-o", "out"), "expected frames of the suite, found none"),
    ],
)
def test_bad_arguments_are_rejected_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], expected: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert expected in refuses("benchmark", *arguments)
    assert list(tmp_path.iterdir()) == []
