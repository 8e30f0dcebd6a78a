"""Output of the command line: progress with the time left, the result in a few lines, and the next command."""

import shlex
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bars

from swimm3r.cli.terminal.output_level import is_quiet
from swimm3r.cli.terminal.pace import Clock, Countdown, Pace, WorkClock, compilation_watched
from swimm3r.pipeline.stage_start import StageStart, ignore_stages
from swimm3r.progress import Progress, silent

_LINE_EVERY_S = 10.0  # in logs, where a bar cannot be redrawn
_COMPILING = "compiling kernels (first run only)"
_UNWRAPPED = 1000  # columns of what is piped into a file: nobody's window ends there


@dataclass(frozen=True)
class Drawn:
    """A `Progress` that is drawn, and the same for the stages of a run."""

    draw: Progress
    begin_stage: Callable[[StageStart], None] = ignore_stages

    def __call__(self, what: str, done: int, total: int, /) -> None:
        self.draw(what, done, total)


@contextmanager
def drawn_progress() -> Iterator[Drawn]:
    """One bar per step of work with its estimated time left, and one for the whole run; or lines in a log.

    With --quiet nothing is drawn.
    """
    if is_quiet():
        yield Drawn(silent)
        return
    console = Console(stderr=True)
    clock = WorkClock()
    if not console.is_terminal:
        with _compilation_told(clock, _once_in_a_while(lambda: print_line(_COMPILING)), lambda: None):
            yield Drawn(lines(clock))  # stages announce themselves by their messages
        return
    columns = (
        TextColumn("{task.description:<28}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}"),
    )
    with Bars(*columns, console=console) as bars:
        compiling = bars.add_task(_COMPILING, total=None, visible=False, left="")
        with _compilation_told(
            clock, lambda: bars.update(compiling, visible=True), lambda: bars.update(compiling, visible=False)
        ):
            yield _bars(bars, clock)


def lines(clock: Clock) -> Progress:
    """A `Progress` for logs: a line when a step begins, one every ten seconds, and one when it is done."""
    paces: dict[str, Pace] = {}
    said: dict[str, float] = {}
    ended: dict[str, int] = {}

    def say(what: str, done: int, total: int, /) -> None:
        if done == total == ended.get(what):
            return  # it was over at once, again
        ended[what] = done if done == total else -1
        pace = paces.setdefault(what, Pace(clock))
        before = pace.round
        left = pace.reach(done, total)
        now = time.monotonic()
        if done < total and pace.round == before and now - said[what] < _LINE_EVERY_S:
            return
        said[what] = now
        about = "" if left is None else f", about {left:.0f} s left"
        print_line(f"{_title(what, pace)} {done}/{total} ({pace.seconds:.0f} s{about})")

    return say


def _bars(bars: Bars, clock: WorkClock) -> Drawn:
    countdown = Countdown(clock)
    whole = bars.add_task("whole run", total=None, visible=False, left="")
    paces: dict[str, Pace] = {}
    tasks: dict[str, TaskID] = {}

    def draw(what: str, done: int, total: int, /) -> None:
        pace = paces.setdefault(what, Pace(clock))
        before = pace.round
        left = pace.reach(done, total)
        about = "" if left is None else f"{_duration(left)} left"
        if what not in tasks:
            tasks[what] = bars.add_task(what, total=total, left="")
        elif pace.round > before:
            bars.reset(tasks[what])
        bars.update(tasks[what], description=_title(what, pace), completed=done, total=total, left=about)
        show_whole()

    def show_whole() -> None:
        seconds = countdown.left()
        if seconds is not None:
            bars.update(whole, left=f"about {_duration(seconds)} left")

    def begin_stage(start: StageStart) -> None:
        countdown.set(start.seconds_left)
        title = f"step {start.number} of {start.count}"
        bars.update(whole, description=title, completed=start.number - 1, total=start.count, visible=True)
        show_whole()

    return Drawn(draw, begin_stage)


def _title(what: str, pace: Pace) -> str:
    return what if pace.round == 1 else f"{what}, round {pace.round}"


def _duration(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}"


def print_line(line: str) -> None:
    """Print a line beside the progress, on stderr."""
    print(line, file=sys.stderr, flush=True)


def _once_in_a_while(say: Callable[[], Any]) -> Callable[[], None]:
    """The same at most every ten seconds."""
    last = -_LINE_EVERY_S

    def maybe() -> None:
        nonlocal last
        if time.monotonic() - last >= _LINE_EVERY_S:
            say()
        last = time.monotonic()

    return maybe


@contextmanager
def _compilation_told(clock: WorkClock, begin: Callable[[], Any], end: Callable[[], Any]) -> Iterator[None]:
    def began() -> None:
        clock.stop()
        begin()

    def ended() -> None:
        clock.go_on()
        end()

    with compilation_watched(began, ended):
        yield


def outcome_console() -> Console:
    """The console for results: as wide as the terminal, and not wrapped when piped into a file."""
    console = Console(markup=False, highlight=False)
    return console if console.is_terminal else Console(markup=False, highlight=False, width=_UNWRAPPED)


def print_results(folder: Path, files: Mapping[str, str]) -> None:
    """The files and folders of a result that exist, each with what it holds."""
    there = {name: what for name, what in files.items() if (folder / name).exists()}
    width = max(map(len, there), default=0)
    console = outcome_console()
    console.print(f"Results in {folder}:", soft_wrap=True)
    for name, what in there.items():
        console.print(f"  {name:<{width}}  {what}")


def print_next(what: str, *command: object) -> None:
    """The next command, as it can be copied into a shell; nothing with --quiet."""
    if not is_quiet():
        told = f"Next, {what}: swimm3r {shlex.join(str(word) for word in command)}"
        outcome_console().print(told, soft_wrap=True)
