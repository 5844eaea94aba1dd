"""The model that keeps to a budget, or to an error."""

import json
from pathlib import Path
from typing import Any

import pytest
from commands import refuses, succeeds
from refusals import refused

import mcdenoise.budget
from mcdenoise.budget import Choice, choose_model
from mcdenoise.data import Sequence, open_sequence
from mcdenoise.models._weights import pretrained_models
from mcdenoise.results import Cell, Machine, Method, Results, Scene
from mcdenoise.shot import ShotSettings

TIMES = {"wild_large": 300.0, "wild": 170.0, "wild_small": 80.0}


@pytest.fixture(autouse=True)
def measured(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """Times that are told, and no cache but the test's; the names of what was measured."""
    names: list[str] = []

    def measure(choice: Choice, *_: Any) -> float:
        names.append(choice.name)
        return TIMES[choice.model] * (1.0 if choice.precision == "float32" else 0.6)

    monkeypatch.setattr(mcdenoise.budget, "_measure", measure)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return names


@pytest.fixture
def sequence(small_sequence: Path) -> Sequence:
    return open_sequence(small_sequence)


@pytest.fixture
def results(tmp_path: Path) -> Path:
    errors = {"wild_large": 0.05, "wild_large, bfloat16": 0.052, "wild": 0.06, "wild_small": 0.08}
    cells = [
        Cell(scene, name, {"SMAPE": error + shift})
        for name, error in errors.items()
        for scene, shift in (("a", -0.01), ("b", 0.01))
    ]
    folder = tmp_path / "results"
    folder.mkdir()
    scenes = [Scene(name, 24, 20, [0], [0], []) for name in ("a", "b")]
    methods = [Method(name, "trainable", f"method{i}", name.partition(",")[0]) for i, name in enumerate(errors)]
    Results("", "", Machine("", 1, 1.0, "cpu", 1, ""), 1, scenes, methods, cells).write(folder)
    return folder


@pytest.mark.parametrize(
    ("limits", "expected"),
    [
        ({"max_error": 0.09}, "wild_small"),
        ({"max_error": 0.055}, "wild_large, bfloat16"),
        ({"max_error": 0.051}, "wild_large"),
        ({"budget": 1000}, "wild_large"),
        ({"budget": 200}, "wild_large, bfloat16"),
        ({"budget": 175, "max_error": 0.07}, "wild"),
        ({"budget": 100}, "wild_small"),
    ],
)
def test_the_choice(sequence: Sequence, results: Path, limits: dict[str, float], expected: str) -> None:
    choice = choose_model(sequence, results=results, **limits)
    assert choice.name == expected
    assert choice.milliseconds <= limits.get("budget", 1000)
    assert choice.error <= limits.get("max_error", 1)


def test_limits_that_no_model_meets_are_told_in_one_line(sequence: Sequence, results: Path) -> None:
    message = refused(lambda: choose_model(sequence, budget=10))
    assert message.startswith("--budget-ms: expected")
    assert "at most 10 ms, found at best wild_small, bfloat16: 48.0 ms" in message
    message = refused(lambda: choose_model(sequence, budget=100, max_error=0.01, results=results))
    assert "at most 0.01 in 100 ms, found at best wild_small: 80.0 ms a frame, SMAPE 0.08" in message
    assert "oidn_temporal" in message
    assert "--max-error: expected a number above 0" in refused(ShotSettings(max_error=-1).check)
    for path in (sequence.root / "inputs").glob("reference*.exr"):
        path.unlink()
    bare = open_sequence(sequence.root)
    assert "expected references in" in refused(lambda: choose_model(bare, max_error=0.1))
    # Without a limit of the error, the slowest method that keeps to the budget is chosen.
    assert choose_model(bare, budget=150).name == "wild, bfloat16"


def test_times_are_measured_once_for_each_size_and_number_of_threads(
    sequence: Sequence, measured: list[str], tmp_path: Path
) -> None:
    cache = tmp_path / "cache" / "mcdenoise" / "run_times.json"
    bare = {"budget": 1000.0}
    for path in (sequence.root / "inputs").glob("reference*.exr"):
        path.unlink()
    sequence = open_sequence(sequence.root)
    first = choose_model(sequence, **bare)
    count = 2 * len(pretrained_models())
    assert len(measured) == count
    assert choose_model(sequence, **bare) == first
    assert len(measured) == count
    times = json.loads(cache.read_text())
    assert all("24x20" in key and "threads" in key for key in times)
    assert [time for key, time in times.items() if key.endswith("x20, wild_small, bfloat16")] == [48]
    cache.write_text("{ damaged")
    assert choose_model(sequence, **bare) == first
    assert len(measured) == 2 * count


def test_the_command_line(small_sequence: Path, tmp_path: Path) -> None:
    command = ["denoise", str(small_sequence), "-o", str(tmp_path / "out"), "--frames", "3"]
    printed = succeeds(*command, "--max-error", "0.9")
    assert "picked wild_small, bfloat16: 48.0 ms a frame, SMAPE 0." in printed
    report = json.loads((tmp_path / "out" / "denoise.json").read_text())
    assert (report["model"], report["precision"]) == ("wild_small", "bfloat16")
    expected = "mcdenoise denoise: --budget-ms: expected a model that takes at most 1 ms"
    assert refuses(*command, "--budget-ms", "1").startswith(expected)
