"""`swimm3r render`: images and a flight from a finished map."""

from pathlib import Path

from swimm3r.cli.terminal.console import drawn_progress
from swimm3r.cli.terminal.options import OutOrDefault, Run
from swimm3r.settings import ClipSecond, CountOrZero, LongSideOrOwn
from swimm3r.splat.settings import MapDevice


def render(
    run: Run,
    /,
    cameras: Path | None = None,
    out: OutOrDefault = None,
    long_side: LongSideOrOwn = 0,
    flight: CountOrZero = 0,
    time: ClipSecond | None = None,
    map_device: MapDevice = "auto",
) -> None:
    """Render a run's map: with its water, without it, the water alone, and depth.

    Args:
        run: Run folder with a finished map.
        cameras: File cameras.json, in the axes of RUN/sfm/cameras.json, with the cameras to render (without lens
            distortion); the training cameras by default.
        out: Folder for the images; RUN/renders/views by default.
        long_side: Longer side of the images in pixels, at most the cameras' own; 0 uses the cameras' own.
        flight: Number of frames of a flight along the cameras, written to OUT/flythrough.mp4; 0 writes none.
        time: Second of the clip at which a dynamic map is rendered; each camera's own by default.
        map_device: Device that renders the map; auto uses CUDA if a GPU and NVIDIA Warp are present.
    """
    from swimm3r.io.files.outputs import output_folder
    from swimm3r.pipeline.renders import render_run
    from swimm3r.scene.run_folder import open_run

    open_run(run, "splat")
    with output_folder(out or run / "renders" / "views"), drawn_progress() as progress:
        folder = render_run(run, cameras, out, long_side, flight, time, progress=progress, map_device=map_device)
    print(f"Images: {folder}")
