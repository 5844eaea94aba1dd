"""The tables of the documentation are those of the measured figures."""

import json
import math
import sys
from pathlib import Path

import pytest
from refusals import refused

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "examples"


@pytest.fixture
def figures(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    import write_tables

    return write_tables


def run(figures, monkeypatch, *arguments: str) -> None:
    monkeypatch.setattr(sys, "argv", ["write_tables.py", *arguments])
    figures.main()


def test_errors_are_geometric_means_over_the_best_setting_of_each_take(figures) -> None:
    noisy, exact, filtered = figures.OIDN
    takes = {
        "shot": {noisy: {"smape": 0.2, "tsmape": 0.4}, filtered: {"smape": 0.4, "tsmape": 0.2}},
        "other": {noisy: {"smape": 0.3, "tsmape": 0.5}, filtered: {"smape": 0.4, "tsmape": 0.5}},
        "still": {noisy: {"smape": 0.3}, filtered: {"smape": 0.2}},
    }
    for row, error in zip(takes.values(), (0.4, 0.1, 0.3), strict=True):
        row[exact] = {key: error if key == "smape" else 0.5 for key in row[noisy]}
    for row, error in zip(takes.values(), (0.1, 0.2, 0.4), strict=True):
        row["mine"] = {key: error for key in row[noisy]}
    found = figures.errors_of(takes, "mine")
    assert found.shots == pytest.approx(math.sqrt(0.5 * 2))
    assert found.worst_shot == pytest.approx(2)
    assert found.flicker == pytest.approx(math.sqrt(0.5 * 0.4))
    assert (found.stills, found.worst_still) == pytest.approx((2, 2))


def test_the_pages_have_the_measured_figures(figures, monkeypatch) -> None:
    run(figures, monkeypatch, str(ROOT / "benchmarks"), "--pages", str(ROOT), "--check")


def test_a_changed_figure_is_found_and_mended(figures, monkeypatch, tmp_path: Path) -> None:
    for name in figures.PAGES:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text((ROOT / name).read_text("utf-8"), "utf-8")
    folder = tmp_path / "measured"
    folder.mkdir()
    times = json.loads((ROOT / "benchmarks" / "run-time.json").read_text("utf-8"))
    times["milliseconds"]["wild"] = [123456.0] * 5
    (folder / "run-time.json").write_text(json.dumps(times), "utf-8")
    for name in ("takes.json", "long.json"):
        (folder / name).write_text((ROOT / "benchmarks" / name).read_text("utf-8"), "utf-8")
    pages = str(tmp_path)
    assert "performance" in refused(run, figures, monkeypatch, str(folder), "--pages", pages, "--check")
    pytest.importorskip("matplotlib")
    run(figures, monkeypatch, str(folder), "--pages", pages)
    assert "123456" in (tmp_path / "docs" / "performance.md").read_text("utf-8")
    assert (tmp_path / figures.PLOT).exists()
    run(figures, monkeypatch, str(folder), "--pages", pages, "--check")
