"""Progress is drawn in terminals and notebooks, nowhere else, and never against the caller's wish."""

import io
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from swimm3r import progress as module
from swimm3r.progress import NotebookBars, Progress, silent, watched


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def work(progress: Progress) -> None:
    for done in (0, 1, 2, 0, 1, 2):  # two rounds
        progress("matching", done, 2)


def broken_work() -> None:
    with watched(None) as progress:
        work(progress)
        progress("rendering", 1, 4)
        raise RuntimeError("broken")


@pytest.fixture
def displayed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The pages that a notebook shows, one after another, in the one place that is updated."""
    pages: list[str] = []

    def display(page: str, display_id: bool) -> SimpleNamespace:
        assert display_id
        assert not pages
        pages.append(page)
        return SimpleNamespace(update=pages.append)

    ipython: Any = ModuleType("IPython")
    ipython.get_ipython = lambda: SimpleNamespace(kernel=object())
    ipython_display: Any = ModuleType("IPython.display")
    ipython_display.HTML, ipython_display.display = str, display
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "IPython.display", ipython_display)
    return pages


def test_nothing_is_drawn_where_stderr_is_a_pipe(capfd: pytest.CaptureFixture[str]):
    with watched(None) as progress:
        assert progress is silent
        work(progress)
    assert capfd.readouterr() == ("", "")


def test_bars_are_drawn_on_a_terminal_and_end_with_the_work(monkeypatch: pytest.MonkeyPatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    monkeypatch.setenv("TERM", "xterm")
    with pytest.raises(RuntimeError, match="broken"):
        broken_work()
    drawn = terminal.getvalue()
    assert "matching" in drawn
    assert "2/2" in drawn
    assert "1/4" in drawn
    assert drawn.rindex("\x1b[?25h") > drawn.rindex("\x1b[?25l")  # the cursor is back


def test_the_callers_progress_is_the_one_that_is_told(monkeypatch: pytest.MonkeyPatch):
    terminal, told = Terminal(), []
    monkeypatch.setattr(sys, "stderr", terminal)
    with watched(lambda what, done, total, /: told.append((what, done, total))) as progress:
        work(progress)
    with watched(silent) as progress:
        work(progress)
    assert told[:2] == [("matching", 0, 2), ("matching", 1, 2)]
    assert terminal.getvalue() == ""


def test_a_notebook_shows_a_bar_per_step_in_one_place(displayed: list[str]):
    with watched(None) as progress:
        assert isinstance(progress, NotebookBars)
        progress("<matching>", 0, 300)
        progress("<matching>", 300, 300)
        progress("rendering", 2, 2)
    assert '<progress value="0" max="300">' in displayed[0]
    assert "&lt;matching&gt; 300/300" in displayed[-1]
    assert "rendering 2/2" in displayed[-1]
    assert "<matching>" not in "".join(displayed)


def test_a_notebook_is_not_redrawn_at_every_call(displayed: list[str]):
    now = 0.0
    bars = NotebookBars(lambda: now)
    for done in range(1000):
        now = done / 1000
        bars("training", done, 1000)
    assert len(displayed) <= 6


def test_ipython_in_a_terminal_is_a_terminal(displayed: list[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys.modules["IPython"], "get_ipython", lambda: SimpleNamespace())
    assert not module._in_notebook()
    with watched(None) as progress:
        assert progress is silent
    assert displayed == []
