"""The site: every method and every operator has its page, and what `make docs` builds works from disk."""

import importlib
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest

from mcdenoise.check.cases import OPS
from mcdenoise.models import list_models
from mcdenoise.models._overview import overview

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def site() -> ModuleType:
    sys.path.insert(0, str(ROOT / "docs" / "site"))
    yield importlib.import_module
    sys.path.remove(str(ROOT / "docs" / "site"))


def test_every_method_has_a_page_with_its_cost_and_its_settings(site) -> None:
    pages = site("methods").pages()
    assert {f"methods/{name}.md" for name in list_models()} | {"methods/index.md"} == set(pages)
    assert all("## How it works" in text and "::: mcdenoise.models" in text for text in list(pages.values())[:-1])
    own = pages["methods/oidn_temporal.md"]
    # The same row as in the table that it is taken from.
    rows = [
        line for line in (ROOT / "docs" / "results.md").read_text("utf-8").splitlines() if "`oidn_temporal` |" in line
    ]
    assert any(line in own for line in rows)
    assert "| run time | " in own
    assert ":func:" not in "".join(pages.values())


def test_every_method_that_can_run_has_a_picture_and_its_errors(site) -> None:
    methods = site("methods")
    pages = methods.pages()
    shown = {name for name in list_models() if f"../close_ups/{name}.webp" in pages[f"methods/{name}.md"]}
    trained = {entry.name for entry in overview() if entry.weights != "to train"}
    assert trained == shown
    pictures = list((ROOT / "docs" / "close_ups").glob("*.webp"))
    assert {path.stem for path in pictures} == shown
    assert sum(path.stat().st_size for path in pictures) < 1.5e6
    smape = {name: float(values[0]) for name, values in methods.errors().items()}
    assert all(value < smape["noisy"] for name, value in smape.items() if name != "noisy")


def test_every_measured_row_is_of_some_method(site) -> None:
    """No row is lost because a table calls a method by another name."""
    methods = site("methods")
    found = {
        methods.method_of(row[0])
        for source in methods.MEASURED
        for _, _, rows in methods.tables(ROOT / "docs" / source)
        for row in rows
    }
    assert {name for name in methods.NAMES.values()} <= found
    assert set(methods.NAMES.values()) <= set(list_models())


def test_every_operator_has_a_page_with_its_cost(site) -> None:
    pages = site("operators").pages()
    assert {f"operators/{op.name}.md" for op in OPS} | {"operators/index.md"} == set(pages)
    assert all("## Cost" in text for place, text in pages.items() if place != "operators/index.md")


def test_figures_show_what_operators_do(site) -> None:
    figures = site("figures")
    assert set(figures.FIGURES) <= {op.name for op in OPS}
    drawn = figures.FIGURES["cross_bilateral_filter"].draw()
    error = {name: float((image - drawn["reference"]).square().mean()) for name, image in drawn.items()}
    assert error["filtered"] < 0.1 * error["noisy"]
    for name, picture in figures.pictures().items():
        assert picture.startswith(b"\x89PNG"), name


@pytest.mark.slow
def test_the_site_is_built_without_a_warning_and_loads_nothing_from_a_network(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs", reason="the site is in the extra mcdenoise[docs]")
    from mkdocs.commands.build import build
    from mkdocs.config import load_config

    build(load_config(str(ROOT / "mkdocs.yml"), site_dir=str(tmp_path)))
    pages = list(tmp_path.rglob("*.html"))
    assert len(pages) > 80
    for page in pages:
        loaded = r"<(?:script|img|iframe|link rel=.?stylesheet.?)[^>]*(?:src|href)=.?https?:[^ >]*"
        remote = re.findall(loaded, page.read_text(encoding="utf-8"))
        assert not remote, (page, remote)
