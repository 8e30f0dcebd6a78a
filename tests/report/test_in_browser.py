"""The page in a real browser: it draws, slides, fits phones, follows the dark, prints, and asks nobody for anything."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from tests.browser import DESKTOP, PHONE, WatchedPage
from tests.report.conftest import pixels

from swimm3r.report import write_report

Opens = Callable[..., WatchedPage]


@pytest.fixture(scope="module")
def report(finished: Path) -> Path:
    return write_report(finished)


def ready(watched: WatchedPage) -> WatchedPage:
    """The page with its 3D scene drawn."""
    watched.page.locator("#scene .window").scroll_into_view_if_needed()
    watched.page.wait_for_selector("#scene.running", timeout=20_000)
    watched.page.wait_for_timeout(300)  # a frame of the software renderer
    return watched


def colorful(image: np.ndarray) -> float:
    """Share of pixels that are neither the scene's background nor gray."""
    return float((np.ptp(image, axis=2) > 40).mean())


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [PHONE, DESKTOP])
def test_nothing_scrolls_sideways_fails_or_leaves_the_page(open_page: Opens, report: Path, width: int, scheme: str):
    watched = ready(open_page(report, width=width, scheme=scheme))
    assert watched.overflow == 0
    assert watched.errors == []
    assert watched.requests == [report.as_uri()]
    wide = "[...document.querySelectorAll('main *')].filter(e => e.getBoundingClientRect().right > innerWidth + 1"
    assert watched.page.evaluate(f"{wide} && !e.closest('.frame, svg')).map(e => e.outerHTML.slice(0, 80))") == []


def test_the_page_is_dark_where_the_reader_asks_for_it(open_page: Opens, report: Path):
    brightness = {
        scheme: pixels(open_page(report, scheme=scheme).page.locator("main > section").first.screenshot()).mean()
        for scheme in ("light", "dark")
    }
    assert brightness["light"] > 200
    assert brightness["dark"] < 80


def test_the_scene_is_drawn_from_disk_and_its_colors_change(open_page: Opens, report: Path):
    page = ready(open_page(report)).page
    canvas = page.locator("#scene canvas")
    restored = pixels(canvas.screenshot())
    assert colorful(restored) > 0.05
    page.get_by_label("as filmed", exact=True).check()
    page.wait_for_timeout(300)
    filmed = pixels(canvas.screenshot())
    drawn = np.ptp(restored, axis=2) > 40
    assert filmed[drawn][:, 2].mean() < 0.6 * restored[drawn][:, 2].mean()  # the water took the red
    page.get_by_label("cameras and path").uncheck()
    page.wait_for_timeout(300)
    assert (pixels(canvas.screenshot()) != filmed).any()


def test_the_scene_turns_zooms_and_comes_back(open_page: Opens, report: Path):
    page = ready(open_page(report)).page
    canvas = page.locator("#scene canvas")

    def drawn() -> np.ndarray:
        page.wait_for_timeout(300)
        return pixels(canvas.screenshot())[20:-20, 20:-20]  # without the ring of the focus

    first = drawn()
    box = canvas.bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 300, box["y"] + 200)
    page.mouse.down()
    page.mouse.move(box["x"] + 420, box["y"] + 230, steps=4)
    page.mouse.up()
    turned = drawn()
    assert np.abs(turned - first).mean() > 2
    page.keyboard.press("+")
    assert np.abs(drawn() - turned).mean() > 1
    page.keyboard.press("Home")
    page.mouse.move(0, 0)
    np.testing.assert_allclose(drawn(), first, atol=3)


def test_a_phone_opens_the_scene_only_when_asked(open_page: Opens, report: Path):
    page = open_page(report, width=PHONE, touch=True, phone=True).page
    page.locator("#scene").scroll_into_view_if_needed()
    page.wait_for_timeout(500)
    assert page.locator("#scene.running").count() == 0
    page.get_by_role("button", name="Open the 3D scene").tap()
    page.wait_for_selector("#scene.running")
    page.wait_for_timeout(300)
    assert colorful(pixels(page.locator("#scene canvas").screenshot())) > 0.05


def test_the_slider_moves_the_image_by_keyboard_and_mouse(open_page: Opens, report: Path):
    page = open_page(report).page
    stage = page.locator(".stage").first
    slider = stage.locator("input")
    shares = {}
    for value in ("0", "50", "100"):
        slider.fill(value)
        shares[value] = pixels(stage.screenshot())[..., 2].mean()  # red, which the water took
    assert shares["0"] > shares["50"] > shares["100"]
    before = stage.screenshot()
    slider.focus()
    for _ in range(20):
        page.keyboard.press("ArrowLeft")
    assert slider.input_value() == "80"
    assert stage.screenshot() != before
    box = stage.bounding_box()
    assert box is not None
    page.mouse.click(box["x"] + 0.25 * box["width"], box["y"] + 50)
    assert 20 <= int(slider.input_value()) <= 30


def test_another_frame_and_its_depth_are_chosen(open_page: Opens, report: Path):
    page = open_page(report).page
    comparison = page.locator(".comparison").first
    stage, first = comparison.locator(".stage"), comparison.locator(".name").inner_text()
    before = stage.screenshot()
    comparison.get_by_role("button").nth(3).click()
    assert comparison.locator(".name").inner_text() != first
    assert comparison.locator("button[aria-pressed=true]").count() == 1
    chosen = stage.screenshot()
    assert chosen != before
    assert not comparison.locator(".depth-scale").is_visible()
    comparison.get_by_label("depth", exact=True).check()
    assert comparison.locator(".depth-scale").is_visible()
    assert stage.screenshot() != chosen


def test_the_two_comparisons_do_not_move_each_other(open_page: Opens, report: Path):
    page = open_page(report).page
    frames, tests = page.locator(".comparison").nth(0), page.locator(".comparison").nth(1)
    tests.get_by_label("rendered without the water").check()
    assert frames.get_by_label("restored").is_checked()
    tests.locator("input[type=range]").fill("10")
    assert frames.locator("input[type=range]").input_value() == "50"


def test_print_shows_every_image_and_no_control(open_page: Opens, report: Path, tmp_path: Path):
    page = open_page(report).page
    page.emulate_media(media="print")
    for hidden in ("#scene", ".compare", "details"):
        assert not page.locator(hidden).first.is_visible(), hidden
    views = page.locator(".frame img")
    assert views.count() == sum(views.nth(i).is_visible() for i in range(views.count()))
    assert page.locator(".depth-scale").first.is_visible()
    pdf = page.pdf(path=str(tmp_path / "report.pdf"), prefer_css_page_size=True, print_background=True)
    assert pdf.startswith(b"%PDF")
    assert 3 <= pdf.count(b"/Type /Page\n") + pdf.count(b"/Type/Page/") <= 9


def test_without_scripts_every_image_is_there(open_page: Opens, report: Path):
    page = open_page(report, scripts=False).page
    views = page.locator(".frame img")
    assert views.count() == sum(views.nth(i).is_visible() for i in range(views.count()))
    assert not page.locator(".compare").first.is_visible()


def test_a_run_of_frames_alone_is_shown(open_page: Opens, make_run: Callable[..., Path]):
    watched = open_page(write_report(make_run(stage="prepare")), width=PHONE)
    assert watched.errors == []
    assert watched.overflow == 0
    assert watched.page.locator(".plain img").first.is_visible()
