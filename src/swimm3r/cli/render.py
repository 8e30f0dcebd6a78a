"""`swimm3r render`: images and videos of a finished map."""

from typing import Annotated

from swimm3r.cli.terminal.console import drawn_progress
from swimm3r.cli.terminal.options import FLAT, OutOrDefault, Run
from swimm3r.pipeline.view_settings import ViewSettings
from swimm3r.splat.settings import MapDevice


def render(
    run: Run,
    /,
    out: OutOrDefault = None,
    views: Annotated[ViewSettings, FLAT] = ViewSettings(),  # noqa: B008
    map_device: MapDevice = "auto",
) -> None:
    """Render a run's map: with its water, without it, the water alone, and depth.

    Args:
        run: Run folder with a finished map.
        out: Folder for the images; RUN/renders/views by default.
        views: Cameras to render, and the form of the result.
        map_device: Device that renders the map; auto uses CUDA if a GPU and NVIDIA Warp are present.
    """
    from swimm3r.io.files.outputs import output_folder
    from swimm3r.pipeline.renders import render_run
    from swimm3r.scene.run_folder import open_run

    open_run(run, "splat")
    with output_folder(out or run / "renders" / "views"), drawn_progress() as progress:
        folder = render_run(run, views, out, progress=progress, map_device=map_device)
    print(f"{'Images' if views.video != 'only' else 'Video'}: {folder}")
