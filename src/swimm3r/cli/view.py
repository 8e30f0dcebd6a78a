"""`swimm3r view`: a finished run in the browser."""

from pathlib import Path
from typing import Annotated

from swimm3r.cli.terminal.console import drawn_progress
from swimm3r.cli.terminal.options import FLAT, Run
from swimm3r.splat.settings import MapDevice
from swimm3r.viewer.settings import ViewerSettings


def view(
    run: Run,
    /,
    settings: Annotated[ViewerSettings, FLAT] = ViewerSettings(),  # noqa: B008 - records are frozen
    water: tuple[Path, ...] = (),
    map_device: MapDevice = "auto",
) -> None:
    """Look at a run in the browser: fly through the map, change its water, measure, keep views and camera paths.

    Args:
        run: Run folder with finished structure from motion; a map, where there is one, is drawn as the camera moves.
            Or a folder of `swimm3r visits`, whose visits and changes are shown.
        settings: The address, and size and pace of the pictures.
        water: Other run folders whose water the scene can be put into.
        map_device: Device that renders the map; auto uses CUDA if a GPU and NVIDIA Warp are present.
    """
    from swimm3r.viewer.server import opened_viewer, serve
    from swimm3r.viewer.visited_site import is_visited_site
    from swimm3r.viewer.visits import opened_visits_viewer, serve_visits

    if is_visited_site(run):
        with drawn_progress() as progress:
            visits = opened_visits_viewer(run, settings, progress)
        serve_visits(visits, ready=_say)
        return
    with drawn_progress() as progress:
        viewer = opened_viewer(run, settings, water, map_device, progress)
    serve(viewer, ready=_say)


def _say(line: str) -> None:
    print(line, flush=True)
