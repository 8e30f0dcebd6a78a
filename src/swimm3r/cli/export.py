"""`swimm3r export`: a finished map in a format that other programs show."""

from swimm3r.cli.terminal.options import OutOrDefault, Run
from swimm3r.settings import ClipSecond


def export(run: Run, /, out: OutOrDefault = None, time: ClipSecond | None = None) -> None:
    """Write a run's map, without its water, as Gaussians for 3DGS viewers, and say how much is lost on the way.

    Args:
        run: Run folder with a finished map.
        out: PLY file to write; RUN/splat/gaussians.ply by default.
        time: Second of the clip at which a dynamic map is exported; half way by default.
    """
    from swimm3r.export import GaussiansSettings, export_run
    from swimm3r.io.files.outputs import output_file
    from swimm3r.scene.run_folder import open_run

    open_run(run, "splat")
    with output_file(out or run / "splat" / "gaussians.ply", "--out") as path:
        done = export_run(run, path, GaussiansSettings(time))
    print(
        f"{done.path}: {done.gaussians:,} Gaussians of {done.primitives:,} primitives.\n"
        f"Beside the map's own clear images: {done.difference.psnr:.1f} dB, mean alpha {done.difference.alpha:+.3f}."
    )
