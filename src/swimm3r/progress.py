"""Progress of long work: told to the caller, and by default drawn in a terminal or a notebook.

Functions for notebooks and scripts take `progress: Progress | None = None` and work inside `watched(progress)`; those
that they call take a `Progress`. The command line draws its own (`cli.terminal`).
"""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from html import escape
from importlib import import_module
from typing import Any, Protocol, runtime_checkable

_REDRAWN_EVERY_S = 0.2  # in a notebook


@runtime_checkable  # so that the suite can check calls against it
class Progress(Protocol):
    """Called as `progress("matching", 12, 300)`. An exception of it (KeyboardInterrupt) stops the work cleanly."""

    def __call__(self, what: str, done: int, total: int, /) -> None: ...


def silent(what: str, done: int, total: int, /) -> None:
    """Nobody is watching."""


@contextmanager
def watched(progress: Progress | None) -> Iterator[Progress]:
    """The progress that was given; else bars in a notebook or where stderr is a terminal, and silence elsewhere."""
    if progress is not None:
        yield progress
    elif _in_notebook():
        yield NotebookBars()
    elif sys.stderr.isatty():
        with _terminal_bars() as bars:
            yield bars
    else:
        yield silent


class NotebookBars:
    """A `Progress` that draws one bar per step below the cell that runs."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._steps: dict[str, tuple[int, int]] = {}  # done and total
        self._drawn: float | None = None
        self._display: Any = None

    def __call__(self, what: str, done: int, total: int, /) -> None:
        self._steps[what] = done, total
        now = self._clock()
        if self._drawn is not None and done < total and now - self._drawn < _REDRAWN_EVERY_S:
            return
        self._drawn = now
        display = import_module("IPython.display")
        page = display.HTML("<br/>".join(_bar(step, *state) for step, state in self._steps.items()))
        if self._display is None:
            self._display = display.display(page, display_id=True)
        else:
            self._display.update(page)


def _bar(what: str, done: int, total: int) -> str:
    return f'<progress value="{done}" max="{max(1, total)}"></progress> {escape(what)} {done}/{total}'


def _in_notebook() -> bool:
    """Return whether the code runs in a Jupyter kernel; IPython in a terminal is a terminal."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return getattr(shell, "kernel", None) is not None


@contextmanager
def _terminal_bars() -> Iterator[Progress]:
    """One bar per step, on stderr, with the time that it took and will take."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    columns = (
        TextColumn("{task.description:<28}"), BarColumn(), MofNCompleteColumn(),
        TimeElapsedColumn(), TimeRemainingColumn(),
    )  # fmt: skip
    with Bars(*columns, console=Console(file=sys.stderr)) as bars:
        steps: dict[str, tuple[TaskID, int]] = {}  # and how far it was

        def draw(what: str, done: int, total: int, /) -> None:
            task, before = steps[what] if what in steps else (bars.add_task(what, total=total), 0)
            if done < before:
                bars.reset(task)  # another round
            bars.update(task, completed=done, total=total)
            steps[what] = task, done

        yield draw
