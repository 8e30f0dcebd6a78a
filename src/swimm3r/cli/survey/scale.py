"""`swimm3r scale`: metres and a place for a finished run."""

from typing import Annotated, Any

from rich.table import Table

from swimm3r.cli.terminal.console import drawn_progress, outcome_console
from swimm3r.cli.terminal.options import FLAT, Run
from swimm3r.scale.settings import ScaleSettings


def scale(
    run: Run,
    /,
    settings: Annotated[ScaleSettings, FLAT] = ScaleSettings(),  # noqa: B008 - records are frozen
) -> None:
    """Give a finished run metres and a place on the map: poses, depth, clouds, map and water are rescaled together.

    Without options, finish a rescaling that was interrupted.

    Args:
        run: Run folder with finished structure from motion.
        settings: Sources of scale and place; any number of them, solved together.
    """
    from swimm3r.report import write_report
    from swimm3r.scale.run import scale_run

    with drawn_progress() as progress:
        section = scale_run(run, settings, progress)
    if (run / "report.html").is_file():
        write_report(run)
    print_scale(section)


def print_scale(section: dict[str, Any]) -> None:
    """Print what the report says of the scale by every source, the scale of all, and the place."""
    from swimm3r.report.scale import scale_section

    console = outcome_console()
    shown = scale_section({"scale": section})
    assert shown is not None
    table = Table("source", "m per unit", "residual", "in std", "of")
    for row in shown.rows:
        table.add_row(row.name + (" (outlier)" if row.outlier else ""), row.scale, row.residual, row.in_std, row.detail)
    console.print(table)
    console.print(shown.lead)
    if section["factor"] == 1.0:
        console.print("The files are in metres already, by these sources: nothing had to be rescaled.")
    for line in shown.lines:
        console.print(line)
    if section.get("files_in_old_unit"):
        console.print(f"In the old unit still, to be made again: {', '.join(section['files_in_old_unit'])}")
