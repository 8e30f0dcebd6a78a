"""`swimm3r export`: a finished map in a format that other programs show."""

from pathlib import Path

from tyro.conf import Positional

from swimm3r.settings import ClipSecond


def export(run: Positional[Path], /, ply: Path | None = None, time: ClipSecond | None = None) -> None:
    """Write a run's map, without its water, as Gaussians for 3DGS viewers, and say how much is lost on the way.

    Args:
        run: the run folder.
        ply: the file to write; RUN/splat/gaussians.ply otherwise.
        time: second of the clip that a dynamic map is exported at; half way where none is given.
    """
    from swimm3r.export.gaussians import export_run
    from swimm3r.io.files.outputs import output_file
    from swimm3r.scene.run_folder import open_run

    open_run(run, "splat")
    with output_file(ply or run / "splat" / "gaussians.ply", "--ply") as path:
        done = export_run(run, path, time)
    print(
        f"{done.path}: {done.gaussians:,} Gaussians of {done.primitives:,} primitives.\n"
        f"Beside the map's own clear images: {done.difference.psnr:.1f} dB, mean alpha {done.difference.alpha:+.3f}."
    )
