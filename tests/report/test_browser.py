"""The page in a real browser: what moves, what sorts, what fits; a headless Chromium of the system."""

import base64
import io
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest
from small_benchmark import FRAMES, HEIGHT, WIDTH, picture

from mcdenoise.report.pictures import to_srgb

pytestmark = pytest.mark.slow
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    if CHROMIUM is None:
        pytest.skip("needs Chromium, which is not installed")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=["--force-color-profile=srgb"])
        yield chromium
        chromium.close()


def open_page(browser: Any, page: Path, complaints: list[str], **options: Any) -> Any:
    tab = browser.new_page(**{"viewport": {"width": 1200, "height": 900}, **options})
    tab.on("console", lambda message: complaints.append(f"{message.type}: {message.text}"))
    tab.on("pageerror", lambda error: complaints.append(str(error)))
    tab.on("request", lambda request: request.url.startswith(("file:", "data:")) or complaints.append(request.url))
    tab.goto(page.as_uri())
    ready(tab)
    tab.check("input[value=seam]", force=True)
    tab.fill("#frame", "0")
    tab.fill("#exposure", "0")
    ready(tab)
    return tab


def ready(tab: Any) -> None:
    tab.wait_for_selector("#stage[data-ready]")


@pytest.fixture
def tab(browser: Any, page: Path) -> Iterator[Any]:
    """The open page; whatever a test does, the console stays silent and nothing is fetched."""
    complaints: list[str] = []
    opened = open_page(browser, page, complaints)
    yield opened
    opened.close()
    assert not complaints


def pixels(tab: Any) -> np.ndarray:
    uri = tab.evaluate("document.querySelector('#stage canvas').toDataURL()")
    return np.asarray(PIL.Image.open(io.BytesIO(base64.b64decode(uri.partition(",")[2]))).convert("RGB")).astype(int)


def choose(tab: Any, left: str, right: str) -> None:
    tab.select_option("#left", left)
    tab.select_option("#right", right)
    ready(tab)


def at(image: np.ndarray, x: float, y: float) -> np.ndarray:
    return image[int(y * image.shape[0]), int(x * image.shape[1])]


def shown(image: np.ndarray, x: float, y: float) -> np.ndarray:
    return at(to_srgb(image), x, y).astype(int)


def test_both_sides_show_their_picture(tab: Any):
    choose(tab, "reference", "ours")
    canvas = pixels(tab)
    reference, ours = picture(0, 0.0, FRAMES[0]), picture(2, 0.1, FRAMES[0])
    for x in (0.13, 0.31):
        # Codes are 8 bit: two steps of the display at most.
        assert np.abs(at(canvas, x, 0.4) - shown(reference, x, 0.4)).max() <= 2
    for x in (0.71, 0.93):
        assert np.abs(at(canvas, x, 0.4) - shown(ours, x, 0.4)).max() <= 2


def test_the_slider_moves_the_seam(tab: Any):
    choose(tab, "noisy", "reference")
    tab.locator("#stage").scroll_into_view_if_needed()
    box = tab.locator("#stage").bounding_box()
    before = pixels(tab)
    seam = tab.locator("#seam").bounding_box()
    y = seam["y"] + seam["height"] / 4
    tab.mouse.move(seam["x"] + seam["width"] / 2, y)
    tab.mouse.down()
    tab.mouse.move(box["x"] + 0.2 * box["width"], y, steps=4)
    tab.mouse.up()
    assert tab.get_attribute("#seam", "aria-valuenow") == "20"
    after = pixels(tab)
    width = before.shape[1]
    changed = np.nonzero((before != after).any((0, 2)))[0]
    # Noisy pixels became clean ones between the two places of the seam, and nowhere else.
    assert 0.19 * width <= changed.min() <= 0.22 * width
    assert 0.48 * width <= changed.max() <= 0.51 * width


def test_exposure_and_tone_curve_change_the_pixels(tab: Any):
    choose(tab, "reference", "reference")
    reference = picture(0, 0.0, FRAMES[0])
    tab.fill("#exposure", "-2")
    ready(tab)
    # A bright disc of radiance 3.2, a quarter of it after two stops.
    place = (60.5 / WIDTH, 30.5 / HEIGHT)
    assert np.abs(at(pixels(tab), *place) - shown(reference / 4, *place)).max() <= 3
    tab.fill("#exposure", "0")
    ready(tab)
    assert (at(pixels(tab), *place) == 255).all()
    tab.select_option("#tone", "reinhard")
    ready(tab)
    assert np.abs(at(pixels(tab), *place) - shown(reference / (1 + reference), *place)).max() <= 2
    tab.select_option("#tone", "linear")
    ready(tab)
    dark = (0.1, 0.9)
    assert np.abs(at(pixels(tab), *dark) - 255 * at(reference, *dark).clip(0, 1)).max() <= 4


def test_error_map_has_the_colours_of_its_legend(tab: Any):
    from matplotlib import colormaps

    choose(tab, "noisy", "reference")
    tab.focus("#stage")
    assert tab.is_hidden("#legend")
    tab.keyboard.press("e")
    ready(tab)
    assert tab.is_visible("#legend")
    canvas = pixels(tab)
    noisy, reference = picture(1, 1.0, FRAMES[0]), picture(0, 0.0, FRAMES[0])
    smape = (np.abs(noisy - reference) / (noisy + reference + 0.01)).mean(-1)
    colors = 255 * np.array(colormaps["inferno"].colors)
    rows, columns = np.mgrid[4:60:7, 4:40:6]
    found = [
        np.abs(colors - at(canvas, (x + 0.5) / WIDTH, (y + 0.5) / HEIGHT)).sum(-1).argmin() / 255 * 0.5
        for y, x in zip(rows.flat, columns.flat, strict=True)
    ]
    assert np.abs(np.array(found) - smape[rows, columns].ravel().clip(0, 0.5)).max() < 0.02
    assert np.abs(at(canvas, 0.8, 0.5) - colors[0]).max() <= 1


def test_a_heading_sorts_its_column(tab: Any):
    tab.select_option("#view", label="first")
    table = tab.locator("#figures table:visible")
    heading = table.locator("th").nth(2)
    column = (
        "[...document.querySelectorAll('#figures [data-view=\"1\"] tbody tr')].map(row => row.cells[2]?.dataset.value)"
    )
    assert heading.get_attribute("aria-sort") == "none"
    heading.locator("button").focus()
    tab.keyboard.press("Enter")
    assert heading.get_attribute("aria-sort") == "ascending"
    values = [float(value) for value in tab.evaluate(column)[:4]]
    assert values == sorted(values)
    heading.locator("button").click()
    assert heading.get_attribute("aria-sort") == "descending"
    order = tab.evaluate(column)
    assert [float(value) for value in order[:4]] == values[::-1]
    assert order[4] is None
    table.locator("th button").first.click()
    assert heading.get_attribute("aria-sort") == "none"
    assert table.locator("tbody th").all_text_contents()[-1].strip() == "absent"


def test_hostile_names_do_nothing(tab: Any):
    assert tab.evaluate("window.broken") is None


def test_a_phone_needs_no_scrolling_sideways(browser: Any, page: Path):
    complaints: list[str] = []
    tab = open_page(browser, page, complaints, viewport={"width": 360, "height": 740})
    assert tab.evaluate("document.documentElement.scrollWidth") == 360
    assert tab.locator("#plots .plot:visible").count() == 1
    tab.close()
    assert not complaints
