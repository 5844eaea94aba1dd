import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from commands import run
from refusals import refused
from small_benchmark import FRAMES, HOSTILE, save

from mcdenoise.report import write_report
from mcdenoise.report import writing as report_writing
from mcdenoise.report.pictures import FORMATS
from mcdenoise.results import Results

VOID = {"meta", "link", "br", "img", "input", "path", "rect", "circle", "use", "hr"}


class Outline(HTMLParser):
    """Elements of a page with their attributes, texts of table rows, and what is not closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.rows: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag == "tr":
            self.rows.append("")
        if self.rows:
            self.rows[-1] += " "
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "tr" in self.open:
            self.rows[-1] += data


@pytest.fixture(scope="module")
def text(page: Path) -> str:
    return page.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def outline(text: str) -> Outline:
    return Outline(text)


def test_the_page_holds_everything(text: str, outline: Outline):
    assert not re.search(r"https?://", text)
    for tag, attributes in outline.elements:
        for name in ("src", "href", "xlink:href", "data", "action"):
            target = attributes.get(name)
            assert target is None or target.startswith(("data:", "#")), (tag, target)
    assert not re.search(r"@import|url\((?!#)", text)
    assert "default-src 'none'" in text


def test_the_page_is_well_formed(outline: Outline):
    assert not outline.open
    ids = [attributes["id"] for _, attributes in outline.elements if "id" in attributes]
    assert len(ids) == len(set(ids))
    targets = [
        attributes["href"][1:] for _, attributes in outline.elements if (attributes.get("href") or "")[:1] == "#"
    ]
    assert targets
    assert set(targets) <= set(ids)


def test_hostile_names_are_text(text: str, outline: Outline):
    scripts = [attributes for tag, attributes in outline.elements if tag == "script"]
    assert len(scripts) == 2
    assert "<script>window" not in text
    assert any(HOSTILE in row for row in outline.rows)
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)[1])
    assert HOSTILE in data["scenes"][0]["pictures"]


def test_missing_and_failed_methods_are_rows_with_their_reasons(outline: Outline):
    rows = [" ".join(row.split()) for row in outline.rows]
    assert "absent missing: the package <absent> is not installed" in rows
    assert "fails second: failed: RuntimeError: out of <memory>" in rows
    assert "fails failed: RuntimeError: out of <memory>" in rows
    assert "ours 4000\N{MULTIPLICATION SIGN}2000 failed: too little <memory>" in rows


def test_figures_are_those_of_the_results(folder: Path, outline: Outline):
    cell = Results.read(folder).cell("first", "ours")
    rows = [" ".join(row.split()) for row in outline.rows]
    assert any(row.startswith(f"ours {cell.errors['SMAPE']:.4f} {cell.errors['PSNR']:.2f} 10") for row in rows)
    assert any("reproject 75%" in row for row in rows)


def test_more_pictures_are_coarser_and_then_smaller(folder: Path, monkeypatch: pytest.MonkeyPatch):
    results = Results.read(folder)
    told = []
    for limits in ((1e9, 1e9, 1e9), (1e3, 1e9, 1e9), (1e3, 2e3, 5e4)):
        formats = tuple((most, *each[1:]) for most, each in zip(limits, FORMATS, strict=True))
        monkeypatch.setattr(report_writing, "FORMATS", formats)
        content = report_writing._comparer(report_writing._galleries(folder, results), [])
        told.append((content["format"], content["factor"], len(json.dumps(content["data"]))))
    assert [each[:2] for each in told] == [("lossless WebP", 1), ("JPEG of quality 88", 1), ("JPEG of quality 75", 2)]
    assert told[0][2] > told[1][2] > told[2][2]


def test_pictures_of_another_size(folder: Path, tmp_path: Path):
    copy = shutil.copytree(folder, tmp_path / "copy", ignore=shutil.ignore_patterns("plots", "index.html"))
    save(copy, "first", "ours", FRAMES[0], np.zeros((8, 8, 3), np.float32))
    assert re.search(r"ours.3\.exr: .*3 channels of 8x8", refused(report_writing._galleries, copy, Results.read(copy)))


@pytest.fixture
def no_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write no files of plots, which takes most of the time."""
    monkeypatch.setattr("mcdenoise.report.plots.write_figure", lambda figure, path: None)


@pytest.mark.usefixtures("no_plots")
def test_without_pictures_the_rest_is_there(folder: Path, tmp_path: Path):
    (tmp_path / "results.json").write_text((folder / "results.json").read_text())
    page = write_report(tmp_path).read_text()
    sections = {attributes["id"] for tag, attributes in Outline(page).elements if tag == "section"}
    assert sections == {"plots", "figures", "stages", "cost", "setup"}
    assert "#closeups" not in page
    assert Outline(page).rows


@pytest.mark.usefixtures("no_plots")
def test_the_command_writes_the_page_of_a_finished_benchmark_again(folder: Path, tmp_path: Path) -> None:
    (folder / "index.html").unlink(missing_ok=True)
    for place, status in ((folder, 0), (tmp_path / "nowhere", 2)):
        assert run("benchmark", "-o", place)[0] == status
    assert (folder / "index.html").exists()
