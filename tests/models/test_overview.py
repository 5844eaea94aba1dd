"""The table of models."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from mcdenoise.cli.models import models
from mcdenoise.models import list_models, overview
from mcdenoise.models._overview import GROUPS
from mcdenoise.models.oidn_open import archive_of_library


def test_lists_every_model_by_group_and_name() -> None:
    entries = overview()
    assert sorted(entry.name for entry in entries) == list_models()
    assert [(GROUPS.index(entry.group), entry.name) for entry in entries] == sorted(
        (GROUPS.index(entry.group), entry.name) for entry in entries
    )
    for entry in entries:
        assert (entry.parameters > 0) is (entry.kmacs_per_pixel is not None)
        assert not entry.trainable or entry.parameters
        assert entry.description or entry.reason
        assert "color" in entry.needs or entry.reason
    by_name = {entry.name: entry for entry in entries}
    tiny = by_name["cascaded_v2_tiny"]
    assert (tiny.group, tiny.pretrained) == ("networks with weights", True)
    # Multiply-adds are no fewer than a sixteenth of the weights, of which each is used once in 4x4 pixels or more.
    assert tiny.kmacs_per_pixel is not None
    assert tiny.kmacs_per_pixel > tiny.parameters / 64 / 1e3
    assert by_name["svgf"].needs == ["color", "depth", "normal"]
    assert (by_name["noisy"].group, by_name["noisy"].uses) == ("without weights", [])


def test_a_model_without_its_package_is_listed_with_the_reason(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    archive_of_library.cache_clear()
    models(tmp_path / "models.json")
    absent = json.loads((tmp_path / "models.json").read_text())[-4:]
    assert [(entry["name"], entry["group"]) for entry in absent] == [
        (name, "not available") for name in ("oidn", "oidn_open", "oidn_pyramid", "oidn_temporal")
    ]
    assert all("pip install 'mcdenoise[oidn]'" in entry["reason"] for entry in absent)
    printed = capsys.readouterr().out
    assert all(name in printed for name in list_models())
    assert "not available" in printed
