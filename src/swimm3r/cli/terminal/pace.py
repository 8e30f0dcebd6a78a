"""Remaining time of a step, estimated from the time of its items so far.

Kernels are compiled in the middle of the first item that needs them, and take longer than hundreds of items. That time
does not count (`WorkClock`), and neither does that of the item that took longest (`Pace`).
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

Clock = Callable[[], float]


class WorkClock:
    """Seconds that stand still while kernels are compiled."""

    def __init__(self, clock: Clock = time.monotonic) -> None:
        self._clock = clock
        self._compiled = 0.0
        self._began: float | None = None

    def __call__(self) -> float:
        now = self._clock()
        return now - self._compiled - (0.0 if self._began is None else now - self._began)

    def stop(self) -> None:
        """Compilation begins."""
        self._began = self._clock()

    def go_on(self) -> None:
        """Compilation has ended."""
        if self._began is not None:
            self._compiled += self._clock() - self._began
            self._began = None


class Pace:
    """Estimates the time left of one step; a step that begins anew is its next round."""

    def __init__(self, clock: Clock = time.monotonic) -> None:
        self._clock = clock
        self._rounds = 0
        self._done = -1
        self._last = 0.0

    @property
    def round(self) -> int:
        """The first round is 1; 0 before the first call of `reach`."""
        return self._rounds

    @property
    def seconds(self) -> float:
        """Time of work since the round began."""
        return self._clock() - self._began

    def reach(self, done: int, total: int) -> float | None:
        """The seconds left once so many items are done; None where too few are to tell."""
        now = self._clock()
        if self._rounds == 0 or done < self._done:
            self._rounds += 1
            self._began = self._last = now
            self._items, self._longest, self._longest_items = 0, 0.0, 0
        elif done > self._done:
            took, items = now - self._last, done - self._done
            self._items += items
            if took / items >= self._longest / max(1, self._longest_items):
                self._longest, self._longest_items = took, items
            self._last = now
        self._done = done
        counted = self._items - self._longest_items
        if counted <= 0 or done >= total:
            return None
        return (self._last - self._began - self._longest) / counted * (total - done)


class Countdown:
    """An estimate of time left that runs down between the moments at which it is renewed."""

    def __init__(self, clock: Clock = time.monotonic) -> None:
        self._clock = clock
        self._ends: float | None = None

    def set(self, seconds: float | None) -> None:
        """So many seconds are left from now on; None where that is not known."""
        self._ends = None if seconds is None else self._clock() + seconds

    def left(self) -> float | None:
        """The seconds left, 0 once they are over."""
        return None if self._ends is None else max(0.0, self._ends - self._clock())


@contextmanager
def compilation_watched(begin: Callable[[], None], end: Callable[[], None]) -> Iterator[None]:
    """Calls `begin` when Numba begins to compile a kernel, and `end` when that kernel and all it calls are compiled.

    Kernels that are found in the cache are not compiled.
    """
    from numba.core import event

    class Watch(event.Listener):
        depth = 0  # a kernel's callees are compiled within it; Numba's lock lets one thread compile at a time

        def on_start(self, event: Any) -> None:
            self.depth += 1
            if self.depth == 1:
                begin()

        def on_end(self, event: Any) -> None:
            self.depth -= 1
            if self.depth == 0:
                end()

    with event.install_listener("numba:compile", Watch()):
        yield
