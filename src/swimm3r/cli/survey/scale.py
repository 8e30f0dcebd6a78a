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
    """Print the scale by every source, the scale of all, and the place."""
    from swimm3r.report.scale import plus_minus

    console = outcome_console()
    table = Table("source", "m per unit", "std", "residual", "in std", "of")
    for each in section["sources"]:
        table.add_row(
            each["source"] + (" (outlier)" if each["outlier"] else ""),
            f"{each['scale']:.6g}",
            f"{100 * each['std']:.2g}%",
            f"{100 * each['residual']:+.2f}%",
            f"{each['residual_in_std']:+.1f}",
            each["detail"],
        )
    console.print(table)
    total, std = section["metres_per_unit"], section["std"]
    console.print(f"A unit of structure from motion is {plus_minus(total, std * total)} m ({100 * std:.2g}%).")
    if section["factor"] == 1.0:
        console.print("The files are in metres already, by these sources: nothing had to be rescaled.")
    place = section["georeference"]
    if place["origin_std_m"] is not None:
        east, north, height = (
            plus_minus(value, error) for value, error in zip(place["origin_m"], place["origin_std_m"], strict=True)
        )
        console.print(f"Origin in {place['crs']}: east {east} m, north {north} m, height {height} m")
    if "navigation" in section:
        navigation = section["navigation"]
        told = f"Navigation: {navigation['rms_m']:.3g} m root mean square over {navigation['positions']} positions"
        if navigation["outliers"]:
            told += f", {navigation['outliers']} of them outliers"
        console.print(told)
    for role, key in (("control", "control_rms_m"), ("check", "check_rms_m")):
        if section.get("control", {}).get(key) is not None:
            console.print(f"Residual at {role} points: {section['control'][key]:.3g} m root mean square")
    for note in section["notes"]:
        console.print(f"Note: {note}")
    if section.get("files_in_old_unit"):
        console.print(f"In the old unit still, to be made again: {', '.join(section['files_in_old_unit'])}")
