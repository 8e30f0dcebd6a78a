"""The viewer in a real browser: a first picture, switches that change it, several browsers at once, no error."""

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from tests.browser import WatchedPage

from swimm3r.viewer.server import Viewer, free_port, started_server
from swimm3r.viewer.settings import ViewerSettings
from swimm3r.viewer.viewed_run import open_viewed_run
from swimm3r.viewer.water import known_waters

WINDOW = {"width": 900, "height": 500}
CANVAS = np.s_[:, :500]  # the panel is to the right
SOFTWARE = "WebGL"  # viser tells that it is drawn in software


@pytest.fixture
def serve() -> Iterator[Callable[[Path], tuple[str, Viewer]]]:
    ended: list[Callable[[], None]] = []

    def start(folder: Path) -> tuple[str, Viewer]:
        settings = ViewerSettings(port=free_port("127.0.0.1", 18_500), moving_side=320, full_side=640)
        viewer = Viewer(open_viewed_run(folder, "cpu"), settings, known_waters(), started_server(settings, "wall"))
        thread = threading.Thread(target=viewer.loop.run)
        thread.start()
        ended.extend([viewer.close, thread.join])
        return f"http://localhost:{viewer.port}", viewer

    yield start
    for end in ended:
        end()


def shown(watched: WatchedPage) -> np.ndarray:
    """The canvas as it is on the screen, RGB."""
    png = np.frombuffer(watched.page.screenshot(), np.uint8)
    image = cv2.imdecode(png, cv2.IMREAD_COLOR)
    assert image is not None
    return image[CANVAS][..., ::-1].astype(int)


def until(condition: Callable[[], bool], watched: WatchedPage, seconds: float = 40.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "not within the time"
        watched.page.wait_for_timeout(150)


def has_picture(watched: WatchedPage) -> bool:
    """Return whether colors are seen; viser's own page is gray until then."""
    return np.ptp(shown(watched)[100:400], axis=-1).mean() > 8


def opened(open_page: Callable[..., WatchedPage], url: str) -> WatchedPage:
    watched = open_page(url, **WINDOW)
    until(lambda: has_picture(watched), watched)
    return watched


def complaints(watched: WatchedPage) -> list[str]:
    return [error for error in watched.errors if SOFTWARE not in error]


def pick(watched: WatchedPage, present: str, wanted: str) -> None:
    watched.page.locator(f'input[value="{present}"]').first.click()
    watched.page.get_by_role("option", name=wanted, exact=True).first.click()


def changes(watched: WatchedPage, act: Callable[[], Any], least: float = 4.0) -> np.ndarray:
    """The picture after an action that has to change it, once it stands still."""
    before = shown(watched)
    act()
    until(lambda: np.abs(shown(watched) - before).mean() > least, watched)
    watched.page.wait_for_timeout(1200)
    return shown(watched)


def test_switches_change_the_picture(open_page: Callable[..., WatchedPage], serve: Any, wall_run: Path):
    url, _ = serve(wall_run)
    watched = opened(open_page, url)
    watched.page.wait_for_timeout(1000)
    present = "With the water"
    for layer in ("Without the water", "Depth", "Surface normals", "Frame restored", "Frame as filmed", present):
        changes(watched, lambda layer=layer, present=present: pick(watched, present, layer))
        present = layer
    other = changes(watched, lambda: pick(watched, "its own", "Jerlov 9C"))
    assert other[..., 2].mean() < other[..., 0].mean()  # turbid coasts take blue first
    assert complaints(watched) == []
    assert all(request.startswith((url, url.replace("http", "ws"))) for request in watched.requests)


def test_moving_the_camera_brings_new_pictures(open_page: Callable[..., WatchedPage], serve: Any, wall_run: Path):
    url, _ = serve(wall_run)
    watched = opened(open_page, url)
    mouse = watched.page.mouse

    def drag() -> None:
        mouse.move(200, 250)
        mouse.down()
        mouse.move(320, 280, steps=6)
        mouse.up()

    changes(watched, drag)
    assert complaints(watched) == []


def test_a_click_on_fly_there_brings_the_frame(open_page: Callable[..., WatchedPage], serve: Any, wall_run: Path):
    url, viewer = serve(wall_run)
    watched = opened(open_page, url)
    watched.page.get_by_role("tab", name="Frames").click()
    changes(watched, lambda: watched.page.get_by_text("Fly there").click(), least=2.0)
    (client,) = viewer.server.get_clients().values()
    expected = (viewer.painter.run.cameras.centers[0] * viewer.painter.run.scale).numpy()
    assert np.allclose(client.camera.position, expected, atol=1e-3)


def test_three_browsers_have_panels_of_their_own(open_page: Callable[..., WatchedPage], serve: Any, wall_run: Path):
    url, viewer = serve(wall_run)
    pages = [opened(open_page, url) for _ in range(3)]
    until(lambda: len(viewer.server.get_clients()) == 3, pages[0])
    before = shown(pages[2])
    changes(pages[0], lambda: pick(pages[0], "With the water", "Depth"))
    assert np.abs(shown(pages[2]) - before).mean() < 2
    pages[0].page.close()
    until(lambda: len(viewer.server.get_clients()) == 2, pages[1])
    changes(pages[1], lambda: pick(pages[1], "With the water", "Surface normals"))
    assert [complaints(page) for page in pages] == [[], [], []]


def test_two_clicks_give_a_length(open_page: Callable[..., WatchedPage], serve: Any, wall_run: Path):
    url, _ = serve(wall_run)
    watched = opened(open_page, url)
    page = watched.page
    page.get_by_role("tab", name="Measure").click()
    page.get_by_label("Click points").first.click()
    page.wait_for_timeout(600)
    for x in (200, 320):
        page.mouse.click(x, 250)
        page.wait_for_timeout(1500)
    until(lambda: "Last length" in page.content(), watched)
    assert " m</strong>" in page.content()


def test_a_run_without_a_map_says_why(open_page: Callable[..., WatchedPage], serve: Any, sfm_run: Path):
    url, _ = serve(sfm_run)
    watched = opened(open_page, url)  # the points
    watched.page.get_by_role("tab", name="About").click()
    until(lambda: "There is no map yet" in watched.page.content(), watched)
    assert complaints(watched) == []
