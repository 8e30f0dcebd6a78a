"""Pictures for every browser that is connected, drawn one at a time.

The latest camera of a browser counts, earlier ones are dropped. While cameras move, pictures are small and the browsers
take turns; their size is adapted so that each gets `pictures_per_second`. A browser whose camera rests then gets one
picture in full. No picture is planned to take longer than `_LONGEST`, which bounds the latency of all others.
"""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from swimm3r.viewer.settings import ViewerSettings

_REST = 0.2  # seconds without a change after which a camera rests
_MOVING = 0.6  # seconds after its last change during which a browser takes its share of the time
_LONGEST = 1.0  # seconds of a picture in full
_PATIENCE = 1.5  # seconds that a camera at rest waits for its picture in full while others move
_SMALLEST = 160  # pixels
_STEP = 0.75  # between two sizes

Request = TypeVar("Request")
Result = TypeVar("Result")


@dataclass(eq=False)
class _Browser(Generic[Request, Result]):
    send: Callable[[Result, bool], None]
    request: Request | None = None
    version: int = 0
    small: int = 0  # version that the last small picture shows
    full: int = 0
    changed: float = -_MOVING
    served: float = 0.0


class RenderLoop(Generic[Request, Result]):
    """Draws the requests of browsers by `draw(request, long side, in full)`; `turn` draws one picture."""

    def __init__(
        self,
        draw: Callable[[Request, int, bool], Result],
        settings: ViewerSettings,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.settings, self.side = settings, settings.moving_side
        self.failure: Exception | None = None
        self._draw, self._clock = draw, clock
        self._browsers: dict[int, _Browser[Request, Result]] = {}
        self._wake = threading.Condition()
        self._stopping = False
        self._seconds_per_pixel = 0.0
        self._was_full = False

    def add(self, browser: int, send: Callable[[Result, bool], None]) -> None:
        """Connect a browser; `send(picture, in full)` is called for each of its pictures."""
        with self._wake:
            self._browsers[browser] = _Browser(send)

    def remove(self, browser: int) -> None:
        """Forget a browser."""
        with self._wake:
            self._browsers.pop(browser, None)

    def ask(self, browser: int, request: Request) -> None:
        """Replace a browser's request."""
        with self._wake:
            found = self._browsers.get(browser)
            if found is None:
                return  # its last message came after it had left
            found.request, found.version, found.changed = request, found.version + 1, self._clock()
            self._wake.notify()

    def ask_again(self) -> None:
        """Draw every browser's picture anew: the map has changed."""
        with self._wake:
            for browser in self._browsers.values():
                browser.version += 1
            self._wake.notify()

    def turn(self) -> bool:
        """Draw the most urgent picture. Returns False where none is wanted now."""
        with self._wake:
            chosen = self._most_urgent()
            if chosen is None:
                return False
            browser, in_full = chosen
            request, version, movers = browser.request, browser.version, self._movers()
        side = self._full_side() if in_full else self.side
        started = self._clock()
        assert request is not None
        picture = self._draw(request, side, in_full)
        browser.send(picture, in_full)
        seconds = self._clock() - started
        with self._wake:
            browser.served, self._was_full = self._clock(), in_full
            if in_full:
                browser.full = version
                browser.small = max(browser.small, version)
            else:
                browser.small = version
        self._seconds_per_pixel = seconds / side**2
        if not in_full:
            self._adapt(seconds, movers)
        return True

    def run(self) -> None:
        """Draw until `stop`. An exception of a picture ends the loop and is kept in `failure`."""
        while not self._stopping:
            try:
                drawn = self.turn()
            except Exception as error:  # noqa: BLE001 - raised again by the thread that waits for this one
                self.failure = error
                self.stop()
                return
            if not drawn:
                with self._wake:
                    if not self._stopping and self._most_urgent() is None:
                        self._wake.wait(_REST / 2)

    def stop(self) -> None:
        """End `run` after the picture it is at."""
        with self._wake:
            self._stopping = True
            self._wake.notify_all()

    @property
    def stopped(self) -> bool:
        """Return whether the loop has ended, or will."""
        return self._stopping

    def _most_urgent(self) -> tuple[_Browser[Request, Result], bool] | None:
        """Small pictures first, then those in full; of each, that of the browser that has waited longest.

        A camera that has rested for long is drawn in full between two small pictures of others.
        """
        asking = [browser for browser in self._browsers.values() if browser.request is not None]
        moving = [browser for browser in asking if browser.small < browser.version]
        now = self._clock()
        patience = _PATIENCE if moving else _REST
        resting = [
            browser
            for browser in asking
            if browser.full < browser.version and browser not in moving and now - browser.changed >= patience
        ]
        in_full = bool(resting) and not (moving and self._was_full)
        waiting = resting if in_full else moving
        return (min(waiting, key=lambda browser: browser.served), in_full) if waiting else None

    def _movers(self) -> int:
        since = self._clock() - _MOVING
        return max(1, sum(browser.changed >= since for browser in self._browsers.values()))

    def _full_side(self) -> int:
        longest = int((_LONGEST / max(self._seconds_per_pixel, 1e-12)) ** 0.5)
        return max(_SMALLEST, min(self.settings.full_side, longest))

    def _adapt(self, seconds: float, movers: int) -> None:
        """Another size of small pictures where they take too long, or could be larger."""
        allowed = 1 / (self.settings.pictures_per_second * movers)
        if seconds > allowed:
            self.side = max(min(_SMALLEST, self.settings.moving_side), round(self.side * _STEP))
        elif seconds < 0.8 * _STEP**2 * allowed:
            self.side = min(self.settings.moving_side, round(self.side / _STEP))
