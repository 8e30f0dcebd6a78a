"""Repeat visits in the browser: the ground of one visit at a time, and the cells that have changed above it."""

import contextlib
import html
import io
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from swimm3r.progress import Progress, silent
from swimm3r.viewer.server import address_lines, ended_by_signals, require_viser, started_server
from swimm3r.viewer.settings import ViewerSettings
from swimm3r.viewer.visited_site import Cells, VisitedSite, open_visited_site
from swimm3r.visits.page import COLORS

if TYPE_CHECKING:
    from viser import ClientHandle, ViserServer

_NO_CHANGES = "none"
_ACROSS = 0.8  # of the site's size, that browsers begin away from its middle
_OVERLAP = 1.1  # of a cell, so that neighbors leave no gap
_BROAD = 1.5  # of a cell, so that changes are seen on steep ground


class VisitsViewer:
    """Serves a site that was visited several times."""

    def __init__(self, site: VisitedSite, settings: ViewerSettings, server: "ViserServer") -> None:
        self.site, self.settings, self.server = site, settings, server
        server.scene.set_up_direction((0.0, 0.0, 1.0))
        start, away, (x, y, z) = server.initial_camera, _ACROSS * site.size, site.middle
        start.position, start.look_at, start.up = (x, y - 0.5 * away, z + away), (x, y, z), (0.0, 0.0, 1.0)
        start.near = away / 1000
        server.on_client_connect(self._connected)

    @property
    def port(self) -> int:
        """The port that is served."""
        return self.server.get_port()

    def close(self) -> None:
        """End the server; browsers say that the connection is lost."""
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints a line of its own
            self.server.stop()

    def _connected(self, client: "ClientHandle") -> None:
        VisitsPanel(client, self.site)


class VisitsPanel:
    """The panel of one browser: a switch between the visits, and one for the changes."""

    def __init__(self, client: "ClientHandle", site: VisitedSite) -> None:
        self._client, self._site = client, site
        names = [visit.name for visit in site.record.visits]
        changes = [change.title for change in site.changes]
        self._visit = client.gui.add_dropdown("Visit", names, initial_value=names[-1])
        self._change = client.gui.add_dropdown("Changes", (_NO_CHANGES, *changes), initial_value=changes[0])
        self._labels = client.gui.add_checkbox("Labels of the largest places", True)
        client.gui.add_html(legend())
        self._told = client.gui.add_markdown("")
        self._grounds = [self._points(f"/visits/{k}", ground) for k, ground in enumerate(site.grounds)]
        self._layers = [self._points(f"/changes/{k}", change.cells, _BROAD) for k, change in enumerate(site.changes)]
        self._words = [
            [
                client.scene.add_label(f"/labels/{k}/{i}", text, position=at, anchor="bottom-center")
                for i, (at, text) in enumerate(change.labels)
            ]
            for k, change in enumerate(site.changes)
        ]
        for control in (self._visit, self._change, self._labels):
            control.on_update(lambda _: self.show())
        self.show()

    def show(self) -> None:
        """Show the ground and the changes that are chosen."""
        names = [visit.name for visit in self._site.record.visits]
        for name, ground in zip(names, self._grounds, strict=True):
            ground.visible = name == self._visit.value
        for change, layer, words in zip(self._site.changes, self._layers, self._words, strict=True):
            chosen = change.title == self._change.value
            layer.visible = chosen
            for word in words:
                word.visible = chosen and self._labels.value
            if chosen:
                self._told.content = "\n\n".join(change.lines)
        if self._change.value == _NO_CHANGES:
            self._told.content = f"The ground at {self._visit.value}, without the water."

    def _points(self, name: str, cells: Cells, size: float = _OVERLAP) -> Any:
        return self._client.scene.add_point_cloud(
            name, cells.xyz, cells.rgb, point_size=size * self._site.cell, point_shape="square",
            precision="float32", point_shading="flat",
        )  # fmt: skip


def legend() -> str:
    """The colors of changes, HTML."""
    marks = "".join(
        f'<span style="margin-right: 0.9em"><span style="color: rgb{color}">&#9632;</span> {html.escape(name)}</span>'
        for name, color in COLORS.items()
    )
    return f'<div style="padding: 0.2em 0.8em 0.6em; font-size: 0.85em">{marks}</div>'


def opened_visits_viewer(
    folder: Path, settings: ViewerSettings | None = None, progress: Progress = silent
) -> VisitsViewer:
    """The viewer of a folder of `swimm3r visits`, which is served from now on.

    Raises InputError where a map is missing or damaged, DeviceError without the packages of `swimm3r[geo]`, UsageError
    where the address cannot be served or viser is not installed.
    """
    settings = settings or ViewerSettings()
    require_viser()
    progress("reading the maps", 0, 1)
    site = open_visited_site(folder)
    progress("reading the maps", 1, 1)
    return VisitsViewer(site, settings, started_server(settings, f"Swimm3R: {folder.resolve().name}"))


def serve_visits(viewer: VisitsViewer, ready: Callable[[str], None] = print) -> None:
    """Serve browsers until Ctrl-C or SIGTERM; `ready` receives the lines that say where they find it."""
    try:
        with ended_by_signals() as ended:
            for line in address_lines(viewer.settings, viewer.port):
                ready(line)
            ready("Ctrl-C ends it.")
            while not ended.wait(0.2):
                pass
    finally:
        viewer.close()
