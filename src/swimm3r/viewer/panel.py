"""The controls of one browser: every switch, slider and button, and the picture that they ask for."""

import html
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch

from swimm3r.errors import Swimm3rError
from swimm3r.geometry import quaternion_from_rotation
from swimm3r.imaging.depth_colors import depth_image
from swimm3r.io.files.refusals import refusal
from swimm3r.viewer import camera_path, measuring
from swimm3r.viewer.camera_path import KeyFrame
from swimm3r.viewer.layers import CropBox, Layer, LayerChoice, Painter, Picture, ViewCamera
from swimm3r.viewer.measuring import SurfacePoint
from swimm3r.viewer.scene_nodes import SceneNodes, vertical_fov, view_of
from swimm3r.viewer.viewed_run import ViewedRun
from swimm3r.viewer.water import OtherWater

if TYPE_CHECKING:
    from viser import ClientHandle, SceneClickEvent

_OWN_WATER = "its own"
_FLIGHT_S, _FLIGHT_STEPS = 0.45, 14
_PLAY_S = 0.12  # between two moments of the clip
_MARK = 0.012  # radius of a measured point, working depth units

Ask = Callable[[tuple[ViewCamera, LayerChoice]], None]


@dataclass
class _Measuring:
    points: list[SurfacePoint]
    on: bool = False


class Panel:
    """The panel of one browser. `ask` receives the camera and the choice whenever one of them changes."""

    def __init__(
        self, client: "ClientHandle", painter: Painter, waters: Sequence[OtherWater], ask: Ask, work: threading.Lock
    ) -> None:
        self._client, self._painter, self._ask, self._work = client, painter, ask, work
        self._waters = {water.name: water for water in waters}
        self._nodes = SceneNodes(client, painter.run, self.fly_to)
        self._measuring, self._key_frames = _Measuring([]), list[KeyFrame]()
        self._frame: str | None = None
        self._closed = threading.Event()
        tabs = client.gui.add_tab_group()
        with tabs.add_tab("View"):
            self._add_view()
        with tabs.add_tab("Frames"):
            self._add_frames()
        with tabs.add_tab("Measure"):
            self._add_measuring()
        with tabs.add_tab("Keep"):
            self._add_keeping()
        with tabs.add_tab("About"):
            client.gui.add_markdown(about(painter))
        client.camera.on_update(lambda _: self._moved())
        self.changed()
        self.show_objects()

    @property
    def run(self) -> ViewedRun:
        """The run that is shown."""
        return self._painter.run

    def close(self) -> None:
        """End what runs on its own: playing."""
        self._closed.set()

    def choice(self) -> LayerChoice:
        """The values of the controls."""
        return LayerChoice(
            layer=cast(Layer, self._layer.value),
            amount=self._amount.value,
            water=self._waters.get(self._water.value),
            exposure=self._exposure.value,
            time=self._time.value,
            crop=self._crop_box(),
            frame=self._frame,
            wipe=self._wipe.value / 100,
        )

    def changed(self) -> None:
        """Ask for the picture of the present camera and controls."""
        self._ask((view_of(self._client, self.run), self.choice()))

    def show(self, picture: Picture, in_full: bool, quality: int) -> None:
        """Put a picture behind the scene; with its depth once the camera rests."""
        depth = None
        if in_full and picture.z_depth is not None and self._is_depth_needed():
            depth = np.where(picture.z_depth > 0, picture.z_depth * self.run.scale, 160.0)
        self._client.scene.set_background_image(
            picture.rgb, format="jpeg", jpeg_quality=min(100, quality + 10 * in_full), depth=depth
        )
        self._client.flush()

    def fly_to(self, name: str) -> None:
        """Move the browser's camera to where a frame was taken."""
        run, camera = self.run, self._client.camera
        lens = run.cameras[run.rec.index(name)]
        self._frame = name
        self._frame_slider.value = run.rec.names.index(name) + 1
        self._frame_name.content = _frame_line(run, name)
        if run.scene is not None and run.scene.dynamic:
            self._time.value = run.time_of(name)
        self._nodes.mark(name)
        start = view_of(self._client, run)
        end = lens.cam2world[0].double()
        turn = quaternion_from_rotation(torch.stack([start.cam2world[:3, :3], end[:3, :3]]))
        if float(turn[0] @ turn[1]) < 0:
            turn[1] *= -1
        fov = vertical_fov(lens, start.aspect)
        for step in range(1, _FLIGHT_STEPS + 1):
            x = step / _FLIGHT_STEPS
            share = x * x * (3 - 2 * x)
            q = torch.nn.functional.normalize((1 - share) * turn[0] + share * turn[1], dim=0).numpy()
            position = ((1 - share) * start.cam2world[:3, 3] + share * end[:3, 3]) * run.scale
            with self._client.atomic():
                camera.fov = start.fov + share * (fov - start.fov)
                camera.wxyz, camera.position = q, position.numpy()
            if step < _FLIGHT_STEPS:
                time.sleep(_FLIGHT_S / _FLIGHT_STEPS)
        pivot = end[:3, 3] + end[:3, 2] * run.median_depth
        camera.look_at = (pivot * run.scale).numpy()
        self.changed()

    # ---------------------------------------------------------------- controls

    def _add_view(self) -> None:
        gui, run, painter = self._client.gui, self.run, self._painter
        first = painter.layers[0] if run.scene is not None else "Points alone"
        self._layer = gui.add_dropdown("Picture", painter.layers, initial_value=first)
        self._legend = gui.add_html(self._legend_of(first))
        self._exposure = gui.add_slider("Exposure (stops)", -3.0, 3.0, 0.1, 0.0)
        start, end = run.frames.span
        dynamic = run.scene is not None and run.scene.dynamic
        self._time = gui.add_slider("Time (s)", start, max(end, start + 0.01), 0.01, start, visible=dynamic)
        self._play = gui.add_checkbox("Play", False, visible=dynamic)
        has_water = run.scene is not None and run.scene.has_water
        with gui.add_folder("Water", visible=has_water):
            self._amount = gui.add_slider(
                "Amount", 0.0, 2.0, 0.05, 1.0, hint="0: no water; 1: as it is; 2: twice as dense"
            )
            self._water = gui.add_dropdown("Kind", (_OWN_WATER, *self._waters), initial_value=_OWN_WATER)
            if not run.rec.metric:
                gui.add_markdown("*The run has no scale: for other waters its median depth counts as 3 m.*")
        with gui.add_folder("Also shown"):
            is_map = run.scene is not None
            self._frusta = gui.add_checkbox("Frames", not is_map)
            self._path = gui.add_checkbox("Path of the camera", not is_map)
            self._points = gui.add_checkbox("Points", not is_map)
            self._point_size = gui.add_slider("Size of the points (mm)" if run.rec.metric else "Size of the points",
                                              1.0, 40.0, 1.0, 8.0)  # fmt: skip
            self._restored = gui.add_checkbox("Points without the water", run.rec.cloud is not None)
        with gui.add_folder("Crop", expand_by_default=False):
            self._crop = gui.add_checkbox("Show only what is inside a box", False)
            low, high = self._extent()
            self._box = [
                gui.add_multi_slider(axis, a, b, (b - a) / 100, (a, b))
                for axis, a, b in zip("XYZ", low, high, strict=True)
            ]
        for control in (self._exposure, self._time, self._amount, self._water):
            control.on_update(lambda _: self.changed())
        for control in (self._frusta, self._path, self._points, self._point_size, self._restored):
            control.on_update(lambda _: self.show_objects())
        for control in (self._crop, *self._box):
            control.on_update(lambda _: self._crop_changed())
        self._layer.on_update(lambda _: self._layer_changed())
        self._play.on_update(lambda _: self._play_clip())

    def _add_frames(self) -> None:
        gui, names = self._client.gui, self.run.rec.names
        self._frame_name = gui.add_markdown(f"{len(names)} frames. Click one in the scene, or choose it here.")
        self._frame_slider = gui.add_slider("Frame", 1, max(2, len(names)), 1, 1)
        fly = gui.add_button("Fly there")
        steps = gui.add_button_group("Neighbor", ("previous", "next"))
        self._wipe = gui.add_slider(
            "Frame over the picture (%)", 0, 100, 1, 0, hint="The left part of the picture shows the frame as filmed"
        )
        nearest = gui.add_button("Always the nearest frame")

        def chosen() -> str:
            return names[min(len(names), self._frame_slider.value) - 1]

        def neighbor(_: Any) -> None:
            step = 1 if steps.value == "next" else -1
            self.fly_to(names[(names.index(chosen()) + step) % len(names)])

        def free(_: Any) -> None:
            self._frame = None
            self._frame_name.content = "The frame whose camera is nearest is shown."
            self.changed()

        fly.on_click(lambda _: self.fly_to(chosen()))
        steps.on_click(neighbor)
        nearest.on_click(free)
        self._wipe.on_update(lambda _: self.show_objects())

    def _add_measuring(self) -> None:
        gui = self._client.gui
        self._measure = gui.add_checkbox("Click points in the picture", False)
        self._measured = gui.add_markdown("Two points give a length, three and more an area, too.")
        clear = gui.add_button("Remove the points")
        self._measure.on_update(lambda _: self._measure_switched())
        clear.on_click(lambda _: self._remove_points())

    def _add_keeping(self) -> None:
        gui = self._client.gui
        self._name = gui.add_text("Name", "", hint="Folder in RUN/renders/views; without one it is numbered")
        keep = gui.add_button("Save this view")
        with gui.add_folder("Camera path"):
            add = gui.add_button("Add this view")
            clear = gui.add_button("Remove all views")
            self._path_line = gui.add_markdown("No views yet.")
            seconds = gui.add_slider("Length of the video (s)", 1.0, 60.0, 0.5, 8.0)
            save = gui.add_button("Save the cameras")
            film = gui.add_button("Make the video", disabled=self.run.scene is None)
        self._kept = gui.add_markdown("")
        add.on_click(lambda _: self._add_key_frame())
        clear.on_click(lambda _: self._clear_key_frames())
        keep.on_click(lambda _: self._keep(self._save_view))
        save.on_click(lambda _: self._keep(self._save_path))
        film.on_click(lambda _: self._keep(lambda: self._film(seconds.value)))

    # ---------------------------------------------------------------- reactions

    def _moved(self) -> None:
        self._nodes.clear_view()
        self.changed()

    def show_objects(self) -> None:
        """Show the objects that are switched on; the wipe has the view to itself."""
        alone = self._wipe.value > 0
        self._nodes.show_frusta(self._frusta.value and not alone)
        self._nodes.show_path(self._path.value and not alone)
        size = self._point_size.value / 1000
        self._nodes.show_cloud(self._points.value, self._restored.value, size, self._crop_box())
        self.changed()

    def _is_depth_needed(self) -> bool:
        """Return whether surfaces are to hide what lies behind them; measured lines stay visible through them."""
        shown = self._frusta.value or self._path.value or self._points.value or self._crop.value
        return shown and not self._measuring.points

    def _layer_changed(self) -> None:
        self._legend.content = self._legend_of(cast(Layer, self._layer.value))
        self.changed()

    def _crop_box(self) -> CropBox | None:
        if not self._crop.value:
            return None
        low, high = zip(*(slider.value for slider in self._box), strict=True)
        return CropBox(low, high)

    def _crop_changed(self) -> None:
        self._nodes.outline(self._crop_box())
        self.show_objects()

    def _extent(self) -> tuple[list[float], list[float]]:
        """The bounds of the crop box: those of all but the outermost points."""
        scene, run = self.run.scene, self.run
        if scene is None:
            xyz = run.cloud(False)[0]
        else:
            xyz = (torch.cat([part.xyz.cpu() for part in scene.parts(coarse=True)]) * run.scale).numpy()
        low, high = np.quantile(xyz[:: max(1, len(xyz) // 100_000)], [0.005, 0.995], axis=0)
        margin = 0.05 * (high - low).max() + 1e-3
        return (low - margin).round(2).tolist(), (high + margin).round(2).tolist()

    def _play_clip(self) -> None:
        start, end = self.run.frames.span
        while self._play.value and not self._closed.wait(_PLAY_S):
            at = self._time.value + _PLAY_S
            self._time.value = at if at <= end else start
            self.changed()

    def _measure_switched(self) -> None:
        scene = self._client.scene
        if self._measure.value and not self._measuring.on:
            scene.on_click()(self._clicked)
        elif not self._measure.value and self._measuring.on:
            scene.remove_click_callback(self._clicked)
        self._measuring.on = self._measure.value

    def _clicked(self, event: "SceneClickEvent") -> None:
        run = self.run
        if run.scene is None:
            xyz, _ = run.cloud(False)
            origin, ray = (np.asarray(v, np.float64) for v in (event.ray_origin, event.ray_direction))
            found = measuring.cloud_point(xyz / run.scale, origin / run.scale, ray)
        else:
            with self._work:
                found = measuring.surface_point(
                    self._painter, view_of(self._client, run), event.screen_pos, self.choice()
                )
        if found is None:
            self._measured.content = "Nothing is there to measure; click on a surface."
            return
        self._measuring.points.append(found)
        self._draw_points()

    def _remove_points(self) -> None:
        self._measuring.points.clear()
        self._draw_points()

    def _draw_points(self) -> None:
        run, scene, points = self.run, self._client.scene, self._measuring.points
        scene.remove_by_name("/measured")
        at = [point.xyz * run.scale for point in points]
        for i, position in enumerate(at):
            scene.add_icosphere(
                f"/measured/{i}", _MARK, (255, 80, 80), position=position, cast_shadow=False, receive_shadow=False
            )
        if len(at) > 1:
            closed = [*at, at[0]] if len(at) > 2 else at
            segments = np.stack([closed[:-1], closed[1:]], 1).astype(np.float32)
            scene.add_line_segments("/measured/lines", segments, (255, 80, 80), thickness=2.5, thickness_units="screen")
            scene.add_label(
                "/measured/label", measuring.told(measuring.length(points[-2:]), run.unit), position=at[-1],
                anchor="bottom-left",
            )  # fmt: skip
        self._measured.content = measured_lines(points, run.unit)
        self.changed()

    def _add_key_frame(self) -> None:
        self._key_frames.append(KeyFrame(view_of(self._client, self.run), self.choice().time))
        self._show_key_frames()

    def _clear_key_frames(self) -> None:
        self._key_frames.clear()
        self._show_key_frames()

    def _show_key_frames(self) -> None:
        run, scene = self.run, self._client.scene
        scene.remove_by_name("/key_frames")
        for i, frame in enumerate(self._key_frames):
            pose = frame.view.cam2world
            scene.add_camera_frustum(
                f"/key_frames/{i}", frame.view.fov, frame.view.aspect, scale=0.15, thickness=2.0,
                thickness_units="screen", color=(120, 220, 255),
                wxyz=quaternion_from_rotation(pose[:3, :3]).numpy(), position=(pose[:3, 3] * run.scale).numpy(),
            )  # fmt: skip
        count = len(self._key_frames)
        self._path_line.content = f"{count} view{'s' * (count != 1)}." if count else "No views yet."

    def _keep(self, save: Callable[[], str]) -> None:
        self._kept.content = "Working ..."
        try:
            self._kept.content = save()
        except (Swimm3rError, OSError) as error:
            told = error if isinstance(error, Swimm3rError) else refusal(error)
            if told is None:
                self._kept.content = f"**Not saved.** {error}"
                raise
            self._kept.content = f"**Not saved.** {told.what}. Try: {told.hint}."

    def _save_view(self) -> str:
        with self._work:
            folder = camera_path.save_view(
                self._painter, view_of(self._client, self.run), self.choice(), self._name.value
            )
        return f"View and camera: `{folder}`"

    def _save_path(self) -> str:
        return f"Cameras: `{camera_path.save_path(self.run, self._key_frames, self._name.value)}`"

    def _film(self, seconds: float) -> str:
        def progress(_: str, done: int, total: int, /) -> None:
            self._kept.content = f"Filming: {done} of {total} images"

        with self._work:
            folder = camera_path.film(self.run, self._key_frames, seconds, self._name.value, progress=progress)
        return f"Video and cameras: `{folder}`"

    def _legend_of(self, layer: Layer) -> str:
        style = self.run.style
        return depth_legend(*style.near_far, self.run.unit) if layer == "Depth" and style is not None else ""


def depth_legend(near: float, far: float, unit: str) -> str:
    """A bar of the depth colors with numbers, HTML; even steps of the bar are even steps in inverse depth."""
    inverse = np.linspace(1 / near, 1 / far, 12)
    colors = depth_image((1 / inverse)[None], near, far)[0]
    stops = ", ".join(f"rgb({r}, {g}, {b})" for r, g, b in colors.tolist())
    marks = "".join(f"<span>{1 / value:.3g}</span>" for value in np.linspace(1 / near, 1 / far, 5))
    return (
        '<div style="padding: 0.2em 0.8em 0.8em; font-size: 0.8em" role="img" aria-label="colors of depth">'
        f'<div style="height: 0.9em; border-radius: 3px; background: linear-gradient(90deg, {stops})"></div>'
        f'<div style="display: flex; justify-content: space-between">{marks}</div>'
        f'<div style="opacity: 0.7">depth along the axis of the camera, {html.escape(unit)}</div></div>'
    )


def measured_lines(points: Sequence[SurfacePoint], unit: str) -> str:
    """Lengths and area of the points, Markdown."""
    if len(points) < 2:
        return "One point. Click another." if points else "Two points give a length, three and more an area, too."
    lines = [f"Last length: **{measuring.told(measuring.length(points[-2:]), unit)}**"]
    if len(points) > 2:
        lines.append(f"Length of the line: **{measuring.told(measuring.length(points), unit)}**")
        lines.append(f"Area: **{measuring.told(measuring.area(points), f'{unit}²')}**")
    lines.append("*± is the spread of the surface between the nearest frames, not the error of the scale.*")
    return "\n\n".join(lines)


def about(painter: Painter) -> str:
    """The facts of a run, and the reasons for what it does not show; Markdown."""
    run = painter.run
    rec, scene = run.rec, run.scene
    lines = [f"**{run.folder.resolve().name}**", f"{len(rec.names)} of {len(run.frames.train)} training frames placed"]
    points = len(rec.points.xyz) if rec.cloud is None else len(rec.cloud.xyz)
    lines.append(f"{points:,} points; lengths in {'metres' if rec.metric else 'scene units, whose size is not known'}")
    if scene is None:
        lines.append(
            "There is no map yet, so the picture is made of points and frames. "
            f"`swimm3r run {run.folder}` trains one: it renders from everywhere, with the water and without."
        )
    else:
        lines.append(f"Map: {scene.settings.recipe}, {scene.count:,} primitives")
        if not scene.has_water:
            lines.append("The map was trained without water, so there is none to take away or to change.")
    if not run.has_restored_frames:
        lines.append("Structure from motion restored no frames: the water was not estimated.")
    lines += [f"⚠ {warning.what} {warning.advice}" for warning in rec.warnings]
    return "\n\n".join(lines)


def _frame_line(run: ViewedRun, name: str) -> str:
    return f"**{name}**, {run.time_of(name):.1f} s"
