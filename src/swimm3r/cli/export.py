"""`swimm3r export`: a finished map in a format that other programs show."""

from typing import Annotated

from swimm3r.cli.terminal.options import FLAT, OutOrDefault, Run
from swimm3r.export.settings import ExportSettings, GaussiansSettings


def export(
    run: Run,
    /,
    out: OutOrDefault = None,
    settings: Annotated[ExportSettings, FLAT] = GaussiansSettings(),  # noqa: B008
) -> None:
    """Write a run's map, without its water, as Gaussians for 3DGS viewers, and say how much is lost on the way.

    Args:
        run: Run folder with a finished map.
        out: PLY file to write; RUN/splat/gaussians.ply by default.
        settings: The format.
    """
    from swimm3r.export import export_run
    from swimm3r.io.files.outputs import output_file
    from swimm3r.scene.run_folder import open_run

    open_run(run, "splat")
    with output_file(out or run / "splat" / settings.file_name, "--out") as path:
        print(export_run(run, path, settings))
