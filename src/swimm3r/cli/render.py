"""`swimm3r render`: images and a flight from a finished map."""

from pathlib import Path

from tyro.conf import Positional

from swimm3r.cli.terminal.console import drawn_progress
from swimm3r.settings import ClipSecond, CountOrZero, LongSideOrOwn


def render(
    run: Positional[Path],
    /,
    cameras: Path | None = None,
    out: Path | None = None,
    long_side: LongSideOrOwn = 0,
    flight: CountOrZero = 0,
    time: ClipSecond | None = None,
) -> None:
    """Render a run's map: with its water, without it, the water alone, and depth.

    Args:
        run: the run folder.
        cameras: a cameras.json in the axes of RUN/sfm/cameras.json, whose cameras (lens distortion left out) are
            rendered; the training cameras otherwise.
        out: where the images go; RUN/renders/views otherwise.
        long_side: longer side of the images, pixels, at most the cameras' own; 0 is the cameras' own.
        flight: film a flight of this many images along the cameras, too: OUT/flythrough.mp4.
        time: second of the clip that a dynamic map is shown at; each camera's, else its frame's, where none is given.
    """
    from swimm3r.io.files.outputs import output_folder
    from swimm3r.pipeline.presets import from_yaml
    from swimm3r.pipeline.renders import render_run
    from swimm3r.scene.run_folder import open_run

    open_run(run, "splat")
    restore = from_yaml(run / "settings.yaml").sfm.restore

    with output_folder(out or run / "renders" / "views"), drawn_progress() as progress:
        folder = render_run(run, cameras, out, long_side, flight, time, restore, progress)
    print(f"Images: {folder}")
