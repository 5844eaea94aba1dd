"""The page in a real browser: what moves, what sorts, what fits; a headless Chromium of the system."""

from __future__ import annotations

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


def open_page(browser: Any, page: Path, complaints: list[str], layout: str = "seam", **options: Any) -> Any:
    tab = browser.new_page(**{"viewport": {"width": 1200, "height": 900}, **options})
    tab.on("console", lambda message: complaints.append(f"{message.type}: {message.text}"))
    tab.on("pageerror", lambda error: complaints.append(str(error)))
    tab.on("request", lambda request: request.url.startswith(("file:", "data:")) or complaints.append(request.url))
    tab.goto(page.as_uri())
    ready(tab)
    tab.check(f"input[value={layout}]", force=True)
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
    """Return the pixels that the comparer's canvas shows."""
    uri = tab.evaluate("document.querySelector('#stage canvas').toDataURL()")
    return np.asarray(PIL.Image.open(io.BytesIO(base64.b64decode(uri.partition(",")[2]))).convert("RGB")).astype(int)


def choose(tab: Any, left: str, right: str) -> None:
    tab.select_option("#left", left)
    tab.select_option("#right", right)
    ready(tab)


def at(image: np.ndarray, x: float, y: float) -> np.ndarray:
    """The pixel at parts of width and height."""
    return image[int(y * image.shape[0]), int(x * image.shape[1])]


def shown(image: np.ndarray, x: float, y: float) -> np.ndarray:
    """Return the value that a display shows there for a scene-linear frame."""
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


def test_three_pictures_stand_side_by_side(browser: Any, page: Path):
    complaints: list[str] = []
    tab = open_page(browser, page, complaints, "beside", viewport={"width": 1400, "height": 900})
    choose(tab, "noisy", "ours")
    canvas = pixels(tab)
    for pane, image in enumerate((picture(1, 1.0, FRAMES[0]), picture(2, 0.1, FRAMES[0]), picture(0, 0.0, FRAMES[0]))):
        assert np.abs(at(canvas, (pane + 0.31) / 3, 0.4) - shown(image, 0.31, 0.4)).max() <= 2
    assert tab.is_hidden("#seam")
    # A pixel is read out in whichever pane the pointer is.
    box = tab.locator("#stage").bounding_box()
    across = (box["width"] - 8) / 3
    for pane in range(3):
        x, y = pane * (across + 4) + (WIDTH // 2 + 0.5) / WIDTH * across, (HEIGHT // 2 + 0.5) / HEIGHT * box["height"]
        tab.mouse.move(box["x"] + x, box["y"] + y)
        assert tab.text_content("#pixel") == f"{WIDTH // 2}, {HEIGHT // 2}"
    tab.set_viewport_size({"width": 500, "height": 900})
    tab.wait_for_function("document.querySelector('#stage').clientHeight > 500")
    tab.close()
    assert not complaints


def test_all_frames_play_until_paused(tab: Any):
    seen = "new Promise(done => { const own = new Set(); const timer = setInterval(() => { own.add("
    seen += "document.querySelector('#frame').value); if (own.size === 3) { clearInterval(timer); done(3); } }, 20); })"
    tab.click("#play")
    assert tab.get_attribute("#play", "aria-label") == "Pause"
    assert tab.evaluate(seen) == 3
    tab.click("#play")
    tab.wait_for_timeout(200)
    frame = tab.input_value("#frame")
    tab.wait_for_timeout(300)
    assert tab.input_value("#frame") == frame


def test_no_column_is_cut_on_a_narrow_screen(browser: Any, page: Path):
    complaints: list[str] = []
    tab = open_page(browser, page, complaints, viewport={"width": 500, "height": 900})
    cut = "[...document.querySelectorAll('.scroll')].filter(one => one.scrollWidth > one.clientWidth).length"
    assert tab.evaluate(cut) == 0
    # Every figure stands below the name of its column.
    cell = "getComputedStyle(document.querySelector('#figures td.number'), '::before').content"
    assert tab.evaluate(cell) == '"SMAPE"'
    tab.close()
    assert not complaints


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


def test_the_seam_by_keyboard(tab: Any):
    tab.focus("#seam")
    tab.keyboard.press("ArrowRight")
    assert tab.get_attribute("#seam", "aria-valuenow") == "52"
    tab.keyboard.press("Shift+ArrowLeft")
    assert tab.get_attribute("#seam", "aria-valuenow") == "42"
    tab.keyboard.press("Home")
    assert tab.get_attribute("#seam", "aria-valuenow") == "0"
    choose(tab, "noisy", "ours")
    assert "noisy left, ours right" in tab.get_attribute("#seam", "aria-valuetext")


def test_zoom_and_pan_keep_both_sides_in_step(tab: Any):
    choose(tab, "reference", "reference")
    whole = pixels(tab)
    scale = float(tab.get_attribute("#stage", "data-scale"))
    tab.focus("#stage")
    for _ in range(3):
        tab.keyboard.press("+")
    assert float(tab.get_attribute("#stage", "data-scale")) == pytest.approx(scale * 1.5**3, rel=1e-3)
    zoomed = pixels(tab)
    assert (zoomed != whole).any()
    # The same picture on both sides shows no seam, and pixels are squares of one colour.
    tab.evaluate("document.querySelector('#seam').focus()")
    tab.keyboard.press("Home")
    assert (pixels(tab) == zoomed).all()
    tab.keyboard.press("End")
    assert (pixels(tab) == zoomed).all()
    assert (zoomed[:, 1:] == zoomed[:, :-1]).all(-1).mean() > 0.95
    tab.focus("#stage")
    tab.keyboard.press("ArrowRight")
    panned = pixels(tab)
    assert (panned[:, :-40] == zoomed[:, 40:]).mean() > 0.97
    tab.keyboard.press("0")
    assert (pixels(tab) == whole).all()


def test_the_wheel_zooms_where_the_pointer_is(tab: Any):
    choose(tab, "reference", "reference")
    tab.locator("#stage").scroll_into_view_if_needed()
    box = tab.locator("#stage").bounding_box()
    x, y = box["x"] + 0.7 * box["width"], box["y"] + 0.3 * box["height"]
    tab.mouse.move(x, y)
    place = tab.text_content("#pixel")
    tab.focus("#stage")
    tab.mouse.wheel(0, -600)
    tab.wait_for_function("Number(document.querySelector('#stage').dataset.scale) > 15")
    tab.mouse.move(x, y)
    assert tab.text_content("#pixel") == place
    assert place == f"{int(0.7 * WIDTH)}, {int(0.3 * HEIGHT)}"


def test_a_comparer_that_was_hidden_comes_back_as_it_was(tab: Any):
    tab.focus("#stage")
    tab.keyboard.press("+")
    before, place = pixels(tab), tab.text_content("#pixel")
    tab.evaluate("document.querySelector('#stage').style.height = '0'")
    tab.wait_for_function("document.querySelector('#stage').clientHeight === 0")
    tab.keyboard.press("+")
    tab.keyboard.press("ArrowUp")
    tab.evaluate("document.querySelector('#stage').style.height = ''")
    tab.wait_for_function("document.querySelector('#stage').clientHeight > 0")
    tab.keyboard.press("Shift+Tab")
    assert tab.text_content("#pixel") == place
    assert (pixels(tab) == before).all()


def test_two_fingers_pinch(browser: Any, page: Path):
    complaints: list[str] = []
    tab = open_page(browser, page, complaints, viewport={"width": 400, "height": 800}, has_touch=True)
    tab.locator("#stage").scroll_into_view_if_needed()
    box = tab.locator("#stage").bounding_box()
    scale = float(tab.get_attribute("#stage", "data-scale"))
    session = tab.context.new_cdp_session(tab)

    def touch(kind: str, *places: float) -> None:
        points = [{"x": box["x"] + part * box["width"], "y": box["y"] + box["height"] / 2} for part in places]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    touch("touchStart", 0.4, 0.6)
    touch("touchMove", 0.3, 0.7)
    touch("touchMove", 0.2, 0.8)
    touch("touchEnd")
    assert float(tab.get_attribute("#stage", "data-scale")) == pytest.approx(3 * scale, rel=0.1)
    tab.close()
    assert not complaints


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
    # The reference has no error.
    assert np.abs(at(canvas, 0.8, 0.5) - colors[0]).max() <= 1


def test_the_scrubber_by_keyboard(tab: Any):
    choose(tab, "reference", "reference")
    assert tab.text_content("#frame-name") == f"{FRAMES[0]} (1 of 3)"
    first = pixels(tab)
    tab.focus("#frame")
    tab.keyboard.press("ArrowRight")
    ready(tab)
    assert tab.text_content("#frame-name") == f"{FRAMES[1]} (2 of 3)"
    assert (pixels(tab) != first).any()
    tab.focus("#stage")
    tab.keyboard.press(",")
    ready(tab)
    assert (pixels(tab) == first).all()


def test_the_pixel_under_the_cursor_is_read_out(tab: Any):
    choose(tab, "reference", "ours")
    tab.locator("#stage").scroll_into_view_if_needed()
    box = tab.locator("#stage").bounding_box()
    x, y = 20, 50
    tab.mouse.move(box["x"] + (x + 0.5) / WIDTH * box["width"], box["y"] + (y + 0.5) / HEIGHT * box["height"])
    assert tab.text_content("#pixel") == f"{x}, {y}"
    cells = tab.locator("#readout tbody tr").nth(1).locator("td").all_text_contents()
    expected = picture(2, 0.1, FRAMES[0])[y, x]
    assert [float(cell) for cell in cells[:3]] == pytest.approx(expected.tolist(), rel=0.03)


def test_scene_and_metric_choose_the_plot(tab: Any):
    def visible() -> list[tuple[str, str]]:
        shown = tab.locator("#plots figure:visible")
        return [(one.get_attribute("data-view"), one.get_attribute("data-metric")) for one in shown.all()]

    assert visible() == [("0", "SMAPE")]
    tab.check("input[value=PSNR]", force=True)
    assert visible() == [("0", "PSNR")]
    tab.select_option("#view", label="second")
    assert visible() == [("2", "PSNR")]
    assert tab.locator("#figures table:visible caption").text_content() == "second"


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


def test_a_close_up_opens_in_the_comparer(tab: Any):
    up = tab.locator("button.crop[data-scene=second][data-method=ours]").first
    up.click()
    ready(tab)
    assert tab.input_value("#right") == "ours"
    assert tab.input_value("#left") == "reference"
    assert tab.text_content("#frame-name") == f"{FRAMES[-1]} (3 of 3)"
    x, y = (float(part) for part in up.get_attribute("data-center").split())
    zoom = float(tab.get_attribute("#stage", "data-scale")) * WIDTH / tab.locator("#stage").bounding_box()["width"]
    assert zoom == pytest.approx(WIDTH / 32 / 2, rel=0.02)
    assert tab.text_content("#pixel").endswith("(middle)")
    middle = [int(part) for part in tab.text_content("#pixel").split(" (")[0].split(", ")]
    # The view is as near to the crop as the border of the picture allows.
    half_x, half_y = WIDTH / zoom / 2, HEIGHT / zoom / 2
    expected = np.clip(x, half_x, WIDTH - half_x), np.clip(y, half_y, HEIGHT - half_y)
    assert np.abs(np.array(middle) - np.floor(expected)).max() <= 1


def test_hostile_names_do_nothing(tab: Any):
    assert tab.evaluate("window.broken") is None


def test_a_phone_needs_no_scrolling_sideways(browser: Any, page: Path):
    complaints: list[str] = []
    tab = open_page(browser, page, complaints, viewport={"width": 360, "height": 740})
    assert tab.evaluate("document.documentElement.scrollWidth") == 360
    assert tab.locator("#plots .plot.narrow:visible").count() == 1
    assert tab.locator("#plots .plot.wide:visible").count() == 0
    tab.close()
    assert not complaints


def contrast(first: str, second: str) -> float:
    def luminance(color: str) -> float:
        parts = np.array([float(part) for part in color[color.index("(") + 1 : -1].split(",")[:3]]) / 255
        linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
        return float(linear @ [0.2126, 0.7152, 0.0722])

    light, dark = sorted((luminance(first), luminance(second)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_is_readable_on_light_and_dark(browser: Any, page: Path, scheme: str):
    complaints: list[str] = []
    tab = open_page(browser, page, complaints, color_scheme=scheme)
    color = "(selector, name) => getComputedStyle(document.querySelector(selector))[name]"
    ground = tab.evaluate(f"({color})('body', 'backgroundColor')")
    assert contrast(ground, "rgb(0, 0, 0)" if scheme == "light" else "rgb(255, 255, 255)") > 15
    for selector, name in (("body", "color"), (".note", "color"), ("a[href]", "color"), (".plot text", "fill")):
        assert contrast(tab.evaluate(f"({color})('{selector}', '{name}')"), ground) > 4.5
    tab.close()
    assert not complaints


def test_print_shows_a_pair_and_plots_without_controls(tab: Any):
    tab.emulate_media(media="print", color_scheme="dark")
    assert tab.is_visible("#stage canvas")
    assert tab.is_visible(".tag.left")
    assert tab.is_visible("#plots figure")
    assert tab.is_hidden("#frame")
    assert tab.is_hidden("nav")
    # Ink on white, even for a reader in the dark.
    assert tab.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(254, 254, 254)"
