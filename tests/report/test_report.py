from __future__ import annotations

import json
import re
import shutil
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_benchmark import FRAMES, HOSTILE, save

from mcdenoise.cli import main
from mcdenoise.data import read_exr, write_exr
from mcdenoise.errors import InputError
from mcdenoise.evaluate import METRICS
from mcdenoise.report import write_report
from mcdenoise.report import writing as report_writing
from mcdenoise.report.pictures import decode
from mcdenoise.report.plots import model_colors, ticks
from mcdenoise.report.views import views
from mcdenoise.results import Method, Results

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


def test_the_verdict_comes_first_and_methods_that_are_left_out_are_named(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(report_writing, "_MOST_METHODS", 3)
    (tmp_path / "results.json").write_text((folder / "results.json").read_text())
    text = write_report(tmp_path).read_text()
    assert re.search(r'<p class="lede"><strong>ours has \d+% less error \(SMAPE\) than .*, in 0.5 times its time', text)
    assert re.search(r"2 more methods.*fails; absent", text, re.S)


def test_the_setup_is_told(text: str):
    for part in ("a &lt;processor&gt;", "21 October 2026, 12:00 UTC", "torch 2.13.0", "2 of 2 cores", "0.0123"):
        assert part in text
    assert "mcdenoise benchmark first second -o OUT" in text


def test_pictures_of_every_method_and_frame(text: str):
    data = json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)[1])
    first, second = data["scenes"]
    assert list(first["pictures"]) == ["noisy", "ours", HOSTILE, "fails", "reference"]
    assert list(second["pictures"]) == ["noisy", "ours", HOSTILE, "reference"]
    assert all(list(own) == [str(frame) for frame in FRAMES] for own in first["pictures"].values())
    assert data["first"] == [HOSTILE, "ours"]
    assert first["start"] == len(FRAMES) - 1
    # The reference is about 0.2 to 0.5, with a disc of 3: a middle gray is a stop darker or less.
    assert -1.5 < first["exposure"] < 1
    assert data["linear"] == pytest.approx(decode(np.arange(256)), rel=1e-4)


def test_every_plot_is_written_for_papers(page: Path):
    names = {path.name for path in (page.parent / "plots").iterdir()}
    names_of_views = ("mean-of-2-scenes-0", "first", "second")
    stems = {"cost"} | {f"{kind}-{view}" for kind in ("smape", "psnr", "stages") for view in names_of_views}
    assert names == {f"{stem}.{suffix}" for stem in stems for suffix in ("svg", "png")}
    svg = (page.parent / "plots" / "smape-first.svg").read_text()
    assert ">ours</text>" in svg
    assert "$x_1$" in svg


def test_the_size_stays_within_its_bound(page: Path, folder: Path, monkeypatch: pytest.MonkeyPatch):
    assert page.stat().st_size < 30e6
    results = Results.read(folder)
    galleries = report_writing._galleries(folder, results)
    lossless = report_writing._comparer(results, galleries, views(results), ["SMAPE"])
    size = len(json.dumps(lossless["data"]["scenes"]))
    monkeypatch.setattr(report_writing, "_PICTURE_BUDGET", size * 2 // 3)
    coarse = report_writing._comparer(results, galleries, views(results), ["SMAPE"])
    assert lossless["format"] == "lossless WebP"
    assert coarse["format"].startswith("JPEG")
    assert len(json.dumps(coarse["data"]["scenes"])) < size * 2 // 3 + 3000


def test_many_pixels_are_made_smaller(folder: Path, monkeypatch: pytest.MonkeyPatch):
    results = Results.read(folder)
    monkeypatch.setattr(report_writing, "_MOST_PIXELS", 27 * 96 * 64 // 4)
    galleries = report_writing._galleries(folder, results)
    assert {gallery.factor for gallery in galleries} == {2}
    assert galleries[0].codes["ours"][FRAMES[0]].shape == (32, 48, 3)
    # Close-ups stay as they are.
    assert galleries[0].close_ups["ours"][0].crop.width == 32


def test_too_many_pictures_are_refused(folder: Path, monkeypatch: pytest.MonkeyPatch):
    results = Results.read(folder)
    monkeypatch.setattr(report_writing, "_PICTURE_BUDGET", 1000)
    with pytest.raises(InputError, match="keep pictures of fewer frames"):
        report_writing._comparer(results, report_writing._galleries(folder, results), views(results), ["SMAPE"])


def copied(folder: Path, target: Path) -> Path:
    return shutil.copytree(folder, target, ignore=shutil.ignore_patterns("plots", "index.html"))


def test_a_folder_without_results(tmp_path: Path):
    with pytest.raises(InputError, match=r"results\.json:"):
        write_report(tmp_path)


def test_pictures_of_another_size(folder: Path, tmp_path: Path):
    copy = copied(folder, tmp_path / "copy")
    save(copy, "first", "ours", FRAMES[0], np.zeros((8, 8, 3), np.float32))
    with pytest.raises(InputError, match=r"ours.3\.exr: .*3 channels of 8x8"):
        report_writing._galleries(copy, Results.read(copy))


def test_pictures_are_shown_in_the_primaries_of_a_display(folder: Path, tmp_path: Path, colour: Any):
    spaces = colour.RGB_COLOURSPACES
    matrix = colour.matrix_RGB_to_RGB(spaces["sRGB"], spaces["ACEScg"], chromatic_adaptation_transform="Bradford")
    primaries = (*spaces["ACEScg"].primaries.flatten().tolist(), *spaces["ACEScg"].whitepoint.tolist())
    copy = copied(folder, tmp_path / "copy")
    results = Results.read(copy)
    before = report_writing._galleries(copy, results)[0].codes["ours"][FRAMES[0]]
    path = copy / "images" / "first" / "ours" / f"{FRAMES[0]}.exr"
    write_exr(
        path, read_exr(path)[0] @ matrix.T, ["R", "G", "B"], full_float=True, metadata={"chromaticities": primaries}
    )
    after = report_writing._galleries(copy, results)[0].codes["ours"][FRAMES[0]]
    # The matrices of both ways are rounded to ten digits: a value on the border of two codes may fall to either side.
    assert np.abs(after.astype(int) - before).max() <= 1


def test_without_pictures_the_rest_is_there(folder: Path, tmp_path: Path):
    (tmp_path / "results.json").write_text((folder / "results.json").read_text())
    page = write_report(tmp_path).read_text()
    sections = {attributes["id"] for tag, attributes in Outline(page).elements if tag == "section"}
    assert sections == {"plots", "figures", "stages", "cost", "setup"}
    assert "#closeups" not in page
    assert Outline(page).rows


def test_a_missing_package_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(InputError, match=r"a report needs matplotlib.*mcdenoise\[report\]"):
        write_report(folder)


def test_the_command_writes_the_page_of_a_finished_benchmark_again(folder: Path, tmp_path: Path) -> None:
    (folder / "index.html").unlink(missing_ok=True)
    for place, status in ((folder, 0), (tmp_path / "nowhere", 2)):
        with pytest.raises(SystemExit) as stop:
            main(["benchmark", "-o", str(place)])
        assert int(stop.value.code or 0) == status
    assert (folder / "index.html").exists()


def test_models_have_colours_of_their_own():
    methods = [
        Method("a", "baseline", "a", "noisy"),
        Method("b", "fixed", "b", "oidn"),
        Method("c", "trainable", "c", "cascaded"),
        Method("d", "trainable", "d", "cascaded", {"width": 4}),
    ]
    colors = model_colors(methods)
    assert list(colors) == ["noisy", "cascaded", "oidn"]
    assert len(set(colors.values())) == 3


@pytest.mark.parametrize(("low", "high"), [(0.04, 0.06), (1, 2), (0.5, 800), (1e-5, 1e5), (99, 101)])
def test_ticks_are_few_and_inside(low: float, high: float):
    places = ticks(low, high)
    assert 1 <= len(places) <= 14
    assert all(low <= place <= high for place in places)


def test_every_metric_is_explained():
    for name in METRICS:
        parts = report_writing._metric(name)["text"]
        assert len("".join(parts)) > 20
        assert len(parts) % 2 == 1
