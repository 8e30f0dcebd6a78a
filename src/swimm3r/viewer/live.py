"""A run watched in the browser while it is made: the map growing, the losses, a test frame beside its render.

Everything is drawn between two steps, in the thread that trains, and only while somebody watches; it gets at most
`_SHARE` of the time. A page that is opened, closed or reloaded changes nothing of the run, and one that fails ends with
a warning: the run goes on.
"""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import Cameras
from swimm3r.evaluate.images import psnr
from swimm3r.imaging.undistortion import undistorted
from swimm3r.localization.interpolation import lens_of
from swimm3r.pipeline.renders import DisplayStyle, display_style
from swimm3r.pipeline.scores.held_out import first_poses
from swimm3r.progress import Progress
from swimm3r.sfm.features.settings import FeatureSettings
from swimm3r.splat.training.observer import TrainingStep
from swimm3r.viewer.server import Viewer, address_lines, started_server
from swimm3r.viewer.settings import ViewerSettings
from swimm3r.viewer.viewed_run import ViewedRun, of_reconstruction
from swimm3r.viewer.water import known_waters

log = logging.getLogger(__name__)

_SHARE = 0.12  # of the training's time that pictures may take
_EVERY_S = {"map": 3.0, "chart": 2.0, "image": 5.0}  # between two updates of each
_TEXT_S = 0.5
_KEPT = 400  # points of the chart
_PREVIEW = 320  # pixels of the image in training
_CURVES = (("loss", "#4cc3e0"), ("l1", "#ffd166"))


@dataclass(frozen=True)
class _ShownView:
    """An image beside which the map is shown."""

    label: str
    camera: Cameras
    image: Float[Tensor, "h w 3"]
    time: float


class LiveView:
    """The page of a run that is being made: an observer of its training, and a progress for all of its stages."""

    def __init__(
        self,
        folder: Path,
        settings: ViewerSettings,
        told: Progress,
        share: float = _SHARE,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.folder, self.settings = folder, settings
        self._told, self._share, self._clock = told, share, clock
        self._thread = threading.current_thread()
        self.server = started_server(settings, f"Swimm3R: {folder.resolve().name}")
        self._group = self.server.gui.add_folder("Run")
        with self._group:
            self._status = self.server.gui.add_markdown("The run begins.")
            self._bar = self.server.gui.add_progress_bar(0.0)
        self._viewer: Viewer | None = None
        self._run: ViewedRun | None = None
        self._style: DisplayStyle | None = None
        self._chart: Any = None
        self._image: Any = None
        self._shown_view: _ShownView | None = None
        self._losses: list[tuple[float | Tensor, ...]] = []
        self._due = dict.fromkeys(_EVERY_S, 0.0)
        self._text_due = 0.0
        self._is_picture_next = True
        self._begun, self._spent = clock(), 0.0
        self._failed = self._closed = False

    @property
    def share_spent(self) -> float:
        """Share of the training's time that was spent on pictures so far."""
        return self._spent / max(1e-9, self._clock() - self._begun)

    def progress(self, what: str, done: int, total: int, /) -> None:
        """A `Progress` that the page shows, too; after the training it keeps drawing the finished map."""
        self._told(what, done, total)
        if self._failed or threading.current_thread() is not self._thread:
            return
        with self._page_alone():
            if self._clock() >= self._text_due or done == total:
                self._text_due = self._clock() + _TEXT_S
                self._status.content = f"**{what}**: {done} of {total}"
                self._bar.value = 100.0 * done / max(1, total)
            if self._viewer is not None and what != "training the map":
                self._spend(self._viewer.loop.turn)

    def observe(self, step: TrainingStep) -> None:
        """Show a step of the training, as far as time and watchers allow; the last one in any case."""
        if self._failed:
            return
        last = step.step == step.iterations
        with self._page_alone():
            if self._viewer is None:
                self._begin(step)
            self._note_losses(step)
            if last or (self.server.get_clients() and self.share_spent <= self._share):
                self._spend(lambda: self._show(step, last))

    def close(self) -> None:
        """End the server, once; the run goes on without a page."""
        if self._closed:
            return
        self._closed = True
        if self._viewer is not None:
            self._viewer.close()
        else:
            with contextlib.suppress(RuntimeError):
                self.server.stop()

    @contextlib.contextmanager
    def _page_alone(self) -> Iterator[None]:
        """Work of the page: an error in it ends the page, not hours of training."""
        try:
            yield
        except Exception as error:  # noqa: BLE001 - said, and the page ends
            self._failed = True
            log.warning("the page of the run ends, the run goes on: %s: %s", type(error).__name__, error)
            self.close()

    def _show(self, step: TrainingStep, last: bool) -> None:
        """One update: a picture for a browser, by turns with a new state of the map, the chart and the test frame."""
        assert self._viewer is not None
        if not last and self._is_picture_next:
            self._is_picture_next = False
            if self._viewer.loop.turn():
                return
        self._is_picture_next = True
        match "map" if last else self._most_overdue():
            case "map":
                self._viewer.painter.run = self._with_map(step)
                self._viewer.loop.ask_again()
            case "chart":
                self._draw_chart()
            case "image":
                self._draw_image()
            case _:
                self._viewer.loop.turn()

    def _begin(self, step: TrainingStep) -> None:
        rec, frames = step.scene.rec, step.scene.views.frames
        self._run = of_reconstruction(self.folder, frames, rec)
        self._begun, self._spent = self._clock(), 0.0
        self._viewer = Viewer(self._with_map(step), self.settings, known_waters(), self.server)

    def _with_map(self, step: TrainingStep) -> ViewedRun:
        assert self._run is not None
        scene = step.map()
        self._style = self._style or display_style(scene, self._run.rec)
        return replace(self._run, scene=scene, style=self._style)

    def _note_losses(self, step: TrainingStep) -> None:
        """Keep the step's losses; tensors stay where they are until the chart is drawn."""
        if step.step % max(1, step.iterations // (4 * _KEPT)) == 0:
            values = (step.numbers.get(name, 0.0) for name, _ in _CURVES)
            self._losses.append((step.step, *(v.detach() if isinstance(v, Tensor) else v for v in values)))

    def _draw_chart(self) -> None:
        rows = self._losses[:: max(1, len(self._losses) // _KEPT)]
        if len(rows) < 2:
            return
        values = np.array([[float(value) for value in row] for row in rows])
        columns = tuple(np.ascontiguousarray(column) for column in values.T)
        if self._chart is None:
            series: Any = (
                {"label": "step"},
                *({"label": name, "stroke": color, "width": 1.5} for name, color in _CURVES),
            )
            axis: Any = {"stroke": "#9fb3bd", "grid": {"stroke": "#3a444a", "width": 1}}
            with self._group:
                self._chart = self.server.gui.add_uplot(
                    columns, series, title="losses", axes=(axis, axis), scales={"x": {"time": False}}, height=130
                )
        else:
            self._chart.data = columns

    def _draw_image(self) -> None:
        """The image that the map is judged by, beside its render."""
        assert self._viewer is not None
        shown = self._shown_view = self._shown_view or self._placed_view()
        scene = self._viewer.painter.run.scene
        assert scene is not None
        rendered = scene.render(shown.camera, shown.time, backscatter=False, observed=False).rgb.clamp(0, 1)
        gap = torch.ones(shown.camera.height, 4, 3)
        pixels = (torch.cat([shown.image, gap, rendered], 1).clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        label = f"{shown.label}: as filmed, and by the map ({psnr(rendered, shown.image):.1f} dB)"
        if self._image is None:
            with self._group:
                self._image = self.server.gui.add_image(pixels, label=label, format="jpeg")
        else:
            self._image.image, self._image.label = pixels, label

    def _placed_view(self) -> "_ShownView":
        """The middle test frame where its pose is found, else the middle training frame."""
        assert self._run is not None
        rec, frames = self._run.rec, self._run.frames
        name, label, pose = rec.names[len(rec.names) // 2], "Training frame", None
        if len(frames.test):
            test = frames.test.names[len(frames.test) // 2]
            chosen = frames.select([i for i, f in enumerate(frames) if f.split == "train" or f.name == test])
            found = first_poses(rec, chosen, FeatureSettings()).get(test)
            if found is not None and found.source == "2D-3D matches":  # a guess would show the map off its place
                name, label, pose = test, "Test frame", found.cam2world
        lens = rec.cameras[rec.index(name)] if pose is None else lens_of(rec, frames, name)
        assert lens is not None, name  # `first_poses` leaves such frames out
        camera = lens.drawn(_PREVIEW)
        number = frames.index(name)
        image, _ = undistorted(frames.image(number), frames.mask(number), lens, camera)
        if pose is not None:
            camera = replace(camera, cam2world=pose[None].to(camera.cam2world))
        return _ShownView(f"{label} {name}", camera, image, frames.times_of([name])[0])

    def _spend(self, work: Callable[[], Any]) -> None:
        started = self._clock()
        work()
        self._spent += self._clock() - started

    def _most_overdue(self) -> str | None:
        """The part of the page whose update has waited longest, and is due; its next one is then set."""
        now = self._clock()
        name = min(_EVERY_S, key=lambda name: self._due[name])
        if self._due[name] > now:
            return None
        self._due[name] = now + _EVERY_S[name]
        return name


@contextlib.contextmanager
def live_view(
    folder: Path, settings: ViewerSettings, told: Progress, ready: Callable[[str], None] = print
) -> Iterator[LiveView]:
    """Serve the page of a run while it is made; `ready` receives the lines that say where.

    Raises UsageError where the address cannot be served or viser is not installed.
    """
    page = LiveView(folder, settings, told)
    for line in address_lines(settings, page.server.get_port()):
        ready(line)
    try:
        yield page
    finally:
        page.close()
