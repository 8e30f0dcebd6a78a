"""`swimm3r export`: a run in the formats of other programs."""

from collections.abc import Callable
from typing import Annotated

from swimm3r.cli.terminal.options import FLAT, OutOrDefault, Run
from swimm3r.export.settings import FOLDERS, FORMATS, FormatName


def export_command(name: FormatName) -> Callable:
    """The command, with the options of a format."""
    default = FORMATS[name]

    def export(
        run: Run,
        /,
        out: OutOrDefault = None,
        format: FormatName = name,
        settings: Annotated[type(default), FLAT] = default,
    ) -> None:
        """Write a run for other programs, and print what is lost on the way: splats, clouds, data sets, trajectories.

        Splats need a finished map; the other formats need structure from motion alone.

        Args:
            run: Run folder to export.
            out: File to write, or a new folder for colmap, nerfstudio, rosbag2 and depth; by default a place in RUN.
            format: Format to write. `--format NAME --help` lists its options.
            settings: Options of the format.
        """
        from swimm3r.export import export_run
        from swimm3r.io.files.outputs import output_file, output_folder
        from swimm3r.scene.run_folder import read_run

        read_run(run)
        path = out or run / settings.file_name
        with (output_folder if isinstance(settings, FOLDERS) else output_file)(path, "--out"):
            print(export_run(run, path, settings))

    return export
