"""The table of models."""

import json
import sys
from pathlib import Path
from typing import get_args

import pytest
from torch import nn

from mcdenoise.cli.models import models
from mcdenoise.models import Needs, create_model, list_models, register_model
from mcdenoise.models._overview import overview
from mcdenoise.models._registry import Kind
from mcdenoise.models._weights import compared_models, pretrained_models
from mcdenoise.models.oidn_open import archive_of_library


def test_lists_every_model_by_kind_and_name() -> None:
    entries, kinds = overview(), get_args(Kind)
    assert sorted(entry.name for entry in entries) == list_models()
    assert [(kinds.index(entry.kind), entry.name) for entry in entries] == sorted(
        (kinds.index(entry.kind), entry.name) for entry in entries
    )
    # "other" is for those of other packages.
    assert all(entry.kind != "other" for entry in entries)
    for entry in entries:
        assert (entry.parameters > 0) is (entry.kmacs_per_pixel is not None)
        model = create_model(entry.name)
        parameters = model.parameters() if isinstance(model, nn.Module) else []
        assert entry.parameters == sum(parameter.numel() for parameter in parameters)
        assert (set(entry.needs), set(entry.uses)) == (model.needs.buffers, model.needs.uses)
        assert entry.trainable is model.needs.trainable
        assert entry.description
        assert "\n" not in entry.description
        assert (entry.weights == "shipped") is (entry.name in pretrained_models())
        assert (entry.weights == "compared") is (entry.name in compared_models())
    by_name = {entry.name: entry for entry in entries}
    small = by_name["wild_small"]
    assert (small.kind, by_name["svgf"].paper) == ("recurrent", "Schied et al. 2017")
    # Multiply-adds are no fewer than a sixteenth of the weights, of which each is used once in 4x4 pixels or more.
    assert small.kmacs_per_pixel > small.parameters / 64 / 1e3
    # Without the filters of noisy features, which have 610.
    assert by_name["wild"].kmacs_per_pixel < 2 * small.kmacs_per_pixel
    assert by_name["svgf"].needs == ["color", "depth", "normal"]
    assert by_name["noisy"].weights == "none"
    assert create_model("noisy").needs == Needs(trainable=False, reach=0)


def test_a_model_without_its_package_is_listed_with_the_reason(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    archive_of_library.cache_clear()
    models(all=True, json=tmp_path / "models.json")
    absent = [entry for entry in json.loads((tmp_path / "models.json").read_text()) if entry["reason"]]
    assert [(entry["name"], entry["kind"]) for entry in absent] == [
        (name, "peer") for name in ("oidn", "oidn_open", "oidn_temporal")
    ]
    assert all("pip install 'mcdenoise[oidn]'" in entry["reason"] for entry in absent)
    printed = capsys.readouterr().out
    assert all(name in printed for name in list_models())
    assert "not available" in printed
    # The text in brackets is not taken for markup.
    assert "[oidn]" in printed


def test_a_kind_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match=r"kind: .*'magic'"):
        register_model("mine", kind="magic")  # type: ignore[arg-type]
