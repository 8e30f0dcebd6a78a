"""What the command line draws: progress with time left, and the outcome in a few lines."""

import logging
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bars
from rich.table import Table

from swimm3r.progress import Progress

_LINE_EVERY_S = 10.0  # in logs, where a bar cannot be redrawn


class MessagePrinter(logging.Handler):
    """Prints messages to what stderr is at that moment: above the bars, while any are drawn."""

    def emit(self, record: logging.LogRecord) -> None:
        print(self.format(record), file=sys.stderr, flush=True)


@contextmanager
def drawn_progress() -> Iterator[Progress]:
    """A `Progress` that draws one bar per kind of work with its estimated time left, or prints lines into a log."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _lines()
        return
    columns = (
        TextColumn("{task.description:<28}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Bars(*columns, console=console) as bars:
        tasks: dict[str, TaskID] = {}

        def draw(what: str, done: int, total: int, /) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=total)
            bars.update(tasks[what], completed=done, total=total)

        yield draw


def _lines() -> Progress:
    began: dict[str, float] = {}
    said: dict[str, float] = {}

    def say(what: str, done: int, total: int, /) -> None:
        now = time.monotonic()
        began.setdefault(what, now)
        if done < total and now - said.get(what, -_LINE_EVERY_S) < _LINE_EVERY_S:
            return
        said[what] = now
        spent = now - began[what]
        left = f", about {spent * (total - done) / done:.0f} s left" if 0 < done < total else ""
        print(f"{what} {done}/{total} ({spent:.0f} s{left})", file=sys.stderr, flush=True)

    return say


def print_summary(summary: dict, folder: Path) -> None:
    """The outcome of a run: what was registered, the water, what to be careful about, and where the report is."""
    console = Console()
    sfm = summary.get("sfm")
    if sfm:
        console.print(
            f"Registered {sfm['registered']} of {sfm['frames']} frames, {sfm['points']:,} points, "
            + ("" if sfm["reprojection_px"] is None else f"reprojection error {sfm['reprojection_px']:.2f} px")
        )
    water = summary.get("medium", {}).get("sfm")
    if water:
        table = Table("water", "R", "G", "B", title=f"betas {water['unit']}, {water['encoding']} values")
        for name in ("Binf", "beta_D", "beta_B"):
            cells = (
                f"{value:.3f}" if known else f"({value:.3f})"
                for value, known in zip(water[name], water["identifiable"][name], strict=True)
            )
            table.add_row(name, *cells)
        console.print(table)
        console.print("In brackets: not determined by these frames.", style="dim")
    test = summary.get("test")
    if test:
        console.print(
            f"{test['views']} test frames: PSNR {_shown(test['psnr'], 1)} dB"
            f" (if blurred by 4 px: {_shown(test['blur4_psnr'], 1)}), SSIM {test['ssim']:.3f},"
            f" sharpness {_shown(test['sharpness'], 2)}"
        )
    for caution in summary.get("cautions", []):
        console.print(f"[bold yellow]![/] {caution['what']} {caution['advice']}")
    if (folder / "report.html").is_file():
        console.print(f"Report: {folder / 'report.html'}")


def _shown(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
