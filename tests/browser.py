"""Pages in the system's Chromium, headless: the `open_page` fixture and what it watches while a page is open.

The browser is the one of the system ($SWIMM3R_CHROMIUM, or the first of the usual names on PATH); Playwright drives it.
Drawing is done in software, so that WebGL works on machines without a graphics card.
"""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-dev-shm-usage")
PHONE, DESKTOP = 390, 1280  # CSS pixels


@dataclass
class WatchedPage:
    """A page and everything it complained about or asked for."""

    page: "Page"
    errors: list[str] = field(default_factory=list)  # console errors, uncaught exceptions, failed requests
    requests: list[str] = field(default_factory=list)  # addresses, without data: and blob:

    @property
    def overflow(self) -> int:
        """Pixels by which the page is wider than its window: 0 where nothing scrolls sideways."""
        return self.page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")


def find_chromium() -> str | None:
    """The path of the system's browser; None without one."""
    named = os.environ.get("SWIMM3R_CHROMIUM")
    return named or next((found for name in NAMES if (found := shutil.which(name))), None)


def reason_to_skip() -> str | None:
    """The reason why no page can be opened on this computer; None where one can."""
    try:
        import playwright.sync_api  # noqa: F401
    except ImportError:
        return "Playwright is not installed (pip install playwright)"
    if find_chromium() is None:
        return f"no Chromium on PATH ({', '.join(NAMES)}) or in $SWIMM3R_CHROMIUM"
    return None


@contextmanager
def headless_chromium() -> Iterator["Browser"]:
    """A running browser, closed at the end of the block."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=find_chromium(), args=list(FLAGS))
        try:
            yield browser
        finally:
            browser.close()


def watched_page(
    browser: "Browser",
    target: str | Path | None = None,
    *,
    width: int = DESKTOP,
    height: int = 800,
    scheme: Literal["light", "dark"] = "light",
    touch: bool = False,
    phone: bool = False,
    scripts: bool = True,
) -> WatchedPage:
    """A new page in a context of its own, with a file or an address opened in it if one is given."""
    context = browser.new_context(
        viewport={"width": width, "height": height},
        color_scheme=scheme,
        has_touch=touch,
        is_mobile=phone,
        java_script_enabled=scripts,
    )
    watched = WatchedPage(context.new_page())
    page = watched.page
    page.on("console", lambda message: _add_console_error(watched, message.type, message.text))
    page.on("pageerror", lambda error: watched.errors.append(f"uncaught: {error}"))
    page.on("requestfailed", lambda request: watched.errors.append(f"failed: {request.url[:200]} {request.failure}"))
    page.on("request", lambda request: _add_request(watched, request.url))
    if target is not None:
        page.goto(target.resolve().as_uri() if isinstance(target, Path) else target)
    return watched


def _add_console_error(watched: WatchedPage, kind: str, text: str) -> None:
    if kind == "error":
        watched.errors.append(text)


def _add_request(watched: WatchedPage, url: str) -> None:
    if not url.startswith(("data:", "blob:")):
        watched.requests.append(url)
