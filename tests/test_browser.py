"""The browser that other tests look at pages with: what it sees, and that it says what it could not check."""

from collections.abc import Callable
from pathlib import Path

import pytest
from tests import browser
from tests.browser import WatchedPage


def written(folder: Path, body: str) -> Path:
    path = folder / "page.html"
    path.write_text(f"<!doctype html><title>page</title><body style='margin:0'>{body}", encoding="utf-8")
    return path


def test_errors_and_requests_of_a_page_are_seen(open_page: Callable[..., WatchedPage], tmp_path: Path):
    quiet = open_page(written(tmp_path, "<p>nothing"))
    assert quiet.errors == []
    assert quiet.requests == [(tmp_path / "page.html").as_uri()]
    loud = open_page(
        written(tmp_path, "<img src='gone.png'><script>console.error('one'); null.two</script><img src='data:,'>")
    )
    loud.page.wait_for_load_state()
    assert any(error == "one" for error in loud.errors)
    assert any("two" in error for error in loud.errors)
    assert (tmp_path / "gone.png").as_uri() in loud.requests
    assert not any(address.startswith("data:") for address in loud.requests)


def test_a_page_that_scrolls_sideways_is_seen(open_page: Callable[..., WatchedPage], tmp_path: Path):
    path = written(tmp_path, "<div style='width:500px'>wide</div>")
    assert open_page(path, width=browser.PHONE).overflow == 500 - browser.PHONE
    assert open_page(path, width=browser.DESKTOP).overflow == 0


def test_webgl_draws_without_a_graphics_card(open_page: Callable[..., WatchedPage]):
    page = open_page().page
    assert page.evaluate("document.createElement('canvas').getContext('webgl2') !== null")


def test_a_machine_without_a_browser_is_told_apart(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.delenv("SWIMM3R_CHROMIUM", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert "no Chromium" in str(browser.reason_to_skip())
