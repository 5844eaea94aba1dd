"""Results as they are stored: what was written is read again, and what is damaged is refused in one line."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from mcdenoise.errors import InputError
from mcdenoise.results import Cell, Cost, Fit, Machine, Method, Results, Scene, Spread

SPREAD = Spread(2.0, 1.0, 4.0, 3)


@pytest.fixture
def results() -> Results:
    return Results(
        command="mcdenoise benchmark plane",
        created="2026-01-01T00:00:00+00:00",
        machine=Machine("a processor", 2, 8.0, "cpu", 1, "an operating system", {"torch": "2"}),
        rounds=3,
        scenes=[Scene("plane", 1000, 500, [0, 1], [1], [1], 0.01)],
        methods=[
            Method("noisy", "baseline", "noisy", "noisy"),
            Method("ours", "trainable", "ours", "ours", {"width": 4}, "ours.safetensors", "bfloat16", True, 12),
            Method("theirs", "fixed", "theirs", "theirs", missing="not installed"),
        ],
        cells=[
            Cell("plane", "noisy", failure="it broke"),
            Cell(
                "plane",
                "ours",
                {"SMAPE": 0.1},
                {"SMAPE": SPREAD},
                SPREAD,
                {"read": SPREAD},
                5.0,
                computing=SPREAD,
                on_the_way={"initial": {"SMAPE": 0.2}},
            ),
        ],
        costs=[Cost("ours", 10, 20, SPREAD), Cost("ours", 1000, 2000, failure="too little memory")],
        fits=[Fit("ours", 1.0, 2.0, 0.1)],
        notes=["FLIP is skipped"],
    )


def test_a_spread_has_the_quartiles_of_its_values() -> None:
    # Between neighbours, as numpy and most others define them.
    assert Spread.of([4.0, 1.0, 3.0, 2.0]) == Spread(2.5, 1.75, 3.25, 4)
    assert Spread.of([7.0]) == Spread(7.0, 7.0, 7.0, 1)


def test_what_is_written_is_read_again(results: Results, tmp_path: Path) -> None:
    results.write(tmp_path)
    assert Results.read(tmp_path) == results


def test_results_of_before_are_read_too(results: Results, tmp_path: Path) -> None:
    results.write(tmp_path)
    content = json.loads((tmp_path / "results.json").read_text())
    del content["notes"]
    for cell in content["cells"]:
        del cell["computing"]
    (tmp_path / "results.json").write_text(json.dumps(content))
    cells = [replace(cell, computing=None) for cell in results.cells]
    assert Results.read(tmp_path) == replace(results, cells=cells, notes=[])


def test_what_is_no_json_is_not_written(results: Results, tmp_path: Path) -> None:
    broken = replace(results, cells=[Cell("plane", "ours", {"PSNR": float("inf")})])
    with pytest.raises(ValueError, match="not JSON compliant"):
        broken.write(tmp_path)
    assert not list(tmp_path.iterdir())


def test_missing_damaged_and_foreign_files_are_refused(results: Results, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"results\.json: expected the results of .*no such file"):
        Results.read(tmp_path)
    results.write(tmp_path)
    path = tmp_path / "results.json"
    text = path.read_text()
    for damaged in (text[:-50], "[]", text.replace('"cells"', '"sells"'), text.replace('"median"', '"mean"')):
        path.write_text(damaged)
        with pytest.raises(InputError, match=r"results\.json: expected the results of .*found damage"):
            Results.read(tmp_path)
    path.write_text(text.replace('"version": 2', '"version": 3'))
    with pytest.raises(InputError, match="expected version 2 of the format, found 3"):
        Results.read(tmp_path)


def test_speed_is_pixels_over_the_time_in_memory(results: Results) -> None:
    noisy, ours = results.cells
    # Half a megapixel in two thousandths of a second.
    assert results.megapixels_per_second(ours) == 250
    assert results.megapixels_per_second(noisy) is None
    assert results.failed
    assert not replace(results, cells=[ours]).failed
