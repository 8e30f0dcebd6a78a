"""`swimm3r visits`: several dives of one site in one frame, and the changes between them."""

from typing import Annotated

from swimm3r.cli.terminal.console import drawn_progress
from swimm3r.cli.terminal.options import FLAT, Out, Runs
from swimm3r.visits.settings import VisitSettings


def visits(
    runs: Runs,
    /,
    out: Out,
    settings: Annotated[VisitSettings, FLAT] = VisitSettings(),  # noqa: B008 - records are frozen
) -> None:
    """Bring several dives of one site into one frame and map the changes: height, volume and clear color.

    Args:
        runs: Run folders with finished structure from motion, in the order of the visits.
        out: Folder that receives the maps, the changed places, visits.json and visits.html.
        settings: Cell size, and the sizes from which a change is reported.
    """
    from swimm3r.visits import write_visits

    with drawn_progress() as progress:
        record = write_visits(runs, out, settings, progress)
    print(record)
    print(f"Page: {out / 'visits.html'}")
