"""The server of the viewer: its address, the browsers that come and go, and a clean end."""

import contextlib
import io
import logging
import signal
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from swimm3r.errors import UsageError
from swimm3r.progress import Progress, silent
from swimm3r.splat.settings import MapDevice
from swimm3r.viewer.layers import LayerChoice, Painter, Picture, ViewCamera
from swimm3r.viewer.panel import Panel
from swimm3r.viewer.render_loop import RenderLoop
from swimm3r.viewer.scene_nodes import vertical_fov
from swimm3r.viewer.settings import ViewerSettings
from swimm3r.viewer.viewed_run import ViewedRun, open_viewed_run
from swimm3r.viewer.water import OtherWater, known_waters

if TYPE_CHECKING:
    from viser import ClientHandle, ViserServer

_TRIED_PORTS = 50
_BRAND = (18, 122, 148)
_WARM_UP_SIDE = 64  # pixels
_END_S = 5.0  # for the picture that is being drawn at the end

Request = tuple[ViewCamera, LayerChoice]


class Viewer:
    """The loop that draws for the browsers of a server. The loop is run by the caller, in any one thread."""

    def __init__(
        self, run: ViewedRun, settings: ViewerSettings, waters: Sequence[OtherWater], server: "ViserServer"
    ) -> None:
        self.painter, self.settings = Painter(run), settings
        self.work = threading.Lock()  # of the renderer: one picture, measurement or video at a time
        self._waters = waters
        self.loop: RenderLoop[Request, Picture] = RenderLoop(self._draw, settings)
        self._panels: dict[int, Panel] = {}
        self.server = server
        self._place_camera(run)
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._left)

    @property
    def port(self) -> int:
        """The port that is served."""
        return self.server.get_port()

    def close(self) -> None:
        """End the loop and the server; browsers say that the connection is lost."""
        self.loop.stop()
        for panel in list(self._panels.values()):
            panel.close()
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints a line of its own
            self.server.stop()

    def _draw(self, request: Request, long_side: int, in_full: bool) -> Picture:
        view, choice = request
        with self.work:
            return self.painter.draw(view, min(long_side, view.window), choice)

    def _connected(self, client: "ClientHandle") -> None:
        def send(picture: Picture, in_full: bool) -> None:
            panel = self._panels.get(client.client_id)
            if panel is not None:
                panel.show(picture, in_full, self.settings.jpeg_quality)

        def ask(request: Request) -> None:
            self.loop.ask(client.client_id, request)

        self.loop.add(client.client_id, send)
        self._panels[client.client_id] = Panel(client, self.painter, self._waters, ask, self.work)
        self._panels[client.client_id].changed()

    def _left(self, client: "ClientHandle") -> None:
        self.loop.remove(client.client_id)
        panel = self._panels.pop(client.client_id, None)
        if panel is not None:
            panel.close()

    def _place_camera(self, run: ViewedRun) -> None:
        """Browsers begin where the middle frame was taken; with points alone, a little behind it."""
        view = starting_view(run)
        pose = view.cam2world.numpy()
        center, ahead = pose[:3, 3], pose[:3, 2] * run.median_depth
        back = 0.0 if run.scene is not None else 0.6
        self.server.scene.set_up_direction(run.up())
        start = self.server.initial_camera
        start.position = (center - back * ahead) * run.scale
        start.look_at = (center + ahead) * run.scale
        start.up = -pose[:3, 1]
        start.fov = view.fov
        start.near = 0.02


def opened_viewer(
    folder: Path,
    settings: ViewerSettings | None = None,
    waters: Sequence[Path] = (),
    map_device: MapDevice = "auto",
    progress: Progress = silent,
) -> Viewer:
    """The viewer of a run, ready to draw; `waters` are other runs whose water it offers.

    Raises InputError where the run is not finished far enough or another run has no water, UsageError where the address
    cannot be served or viser is not installed.
    """
    settings = settings or ViewerSettings()
    require_viser()
    progress("preparing the view", 0, 3)
    run = open_viewed_run(folder, map_device)
    others = known_waters(waters)
    progress("preparing the view", 1, 3)
    if run.scene is not None:  # compiled and in memory before the first browser waits for it
        Painter(run).draw(starting_view(run), _WARM_UP_SIDE, LayerChoice("Without the water"))
        Painter(run).draw(starting_view(run), _WARM_UP_SIDE, LayerChoice())
    progress("preparing the view", 2, 3)
    viewer = Viewer(run, settings, others, started_server(settings, f"Swimm3R: {folder.resolve().name}"))
    progress("preparing the view", 3, 3)
    return viewer


def serve(viewer: Viewer, ready: Callable[[str], None] = print) -> None:
    """Draw for browsers until Ctrl-C or SIGTERM; `ready` receives the lines that say where they find it."""
    drawing = threading.Thread(target=viewer.loop.run, name="pictures")
    try:
        with ended_by_signals() as ended:
            drawing.start()
            for line in address_lines(viewer.settings, viewer.port):
                ready(line)
            ready("Ctrl-C ends it.")
            while not ended.wait(0.2) and not viewer.loop.stopped:
                pass
    finally:
        viewer.close()
        if drawing.ident is not None:
            drawing.join(_END_S)
    if viewer.loop.failure is not None:
        raise viewer.loop.failure


def starting_view(run: ViewedRun) -> ViewCamera:
    """The view where the middle frame was taken."""
    middle = run.cameras[len(run.cameras) // 2]
    return ViewCamera(middle.cam2world[0].double(), vertical_fov(middle), middle.width / middle.height)


def require_viser() -> None:
    """Raise UsageError where viser is not installed."""
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise UsageError(
            "the viewer needs viser, which is not installed",
            cause="Swimm3R was installed without its view extra",
            hint="pip install 'swimm3r[view]'",
        ) from error


def started_server(settings: ViewerSettings, label: str) -> "ViserServer":
    """A viser server at the address, or at the next free port. Raises UsageError where none of them can be served."""
    require_viser()
    import viser

    logging.getLogger("websockets").setLevel(logging.ERROR)
    port = free_port(settings.host, settings.port)
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints a table of its own
        server = viser.ViserServer(host=settings.host, port=port, label=label, verbose=False)
    server.gui.configure_theme(
        dark_mode=True, show_logo=False, show_share_button=False, brand_color=_BRAND, control_width="medium"
    )
    return server


def free_port(host: str, port: int) -> int:
    """The port, or the next one that is free. Raises UsageError where the host is not this computer's, or none is."""
    refused: OSError | None = None
    for tried in range(port, min(port + _TRIED_PORTS, 65_536)):
        try:
            family = socket.getaddrinfo(host, tried, type=socket.SOCK_STREAM)[0][0]
            with socket.socket(family, socket.SOCK_STREAM) as trial:
                trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                trial.bind((host, tried))
            return tried
        except OSError as error:
            refused = error
    assert refused is not None
    raise UsageError(
        f"cannot serve on {host}, port {port} or the {_TRIED_PORTS - 1} after it: {refused.strerror or refused}",
        cause="the address is not one of this computer, or other programs use its ports",
        hint="--host 127.0.0.1, or another --port",
    ) from refused


def address_lines(settings: ViewerSettings, port: int) -> list[str]:
    """Lines for the terminal: the page's address, the way to it from elsewhere, and a port that was taken."""
    lines = []
    if port != settings.port:
        lines.append(f"Port {settings.port} is taken; using {port}.")
    local = settings.host in ("127.0.0.1", "localhost", "::1")
    shown = "localhost" if settings.host in ("0.0.0.0", "::") or local else settings.host
    lines.append(f"Viewer: http://{shown}:{port}")
    name = socket.gethostname()
    if local:
        lines.append(f"From another computer: ssh -L {port}:localhost:{port} user@{name}, then the same address there.")
    else:
        lines.append(f"From another computer: http://{name}:{port} (everyone who can reach it can look).")
    return lines


@contextlib.contextmanager
def ended_by_signals() -> Iterator[threading.Event]:
    """An event that Ctrl-C and SIGTERM set, in the place of what they do otherwise."""
    ended = threading.Event()
    before = {}

    def end(_: int, __: FrameType | None) -> None:
        ended.set()

    if threading.current_thread() is threading.main_thread():
        before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield ended
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
