"""Objects of the browser's 3D scene: the frames as frusta with thumbnails, the camera's path, the cloud, the crop box.

The picture lies behind them; once the camera rests, its depth hides those that lie behind a surface.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from swimm3r.cameras import Cameras
from swimm3r.geometry import pose_from, quaternion_from_rotation, rotation_from_quaternion
from swimm3r.scene.frames import rows_of_one_camera
from swimm3r.viewer.layers import CropBox, ViewCamera
from swimm3r.viewer.viewed_run import ViewedRun

if TYPE_CHECKING:
    from viser import ClientHandle

FRAME_COLOR, CHOSEN_COLOR, PATH_COLOR = (255, 209, 102), (255, 120, 60), (255, 209, 102)
_MOST_FRUSTA = 150
_MOST_POINTS = 250_000
_FRUSTUM = (0.06, 0.16)  # smallest and largest size, working units
_NEAR = 2.0  # sizes of a frustum: nearer than that it would fill the view, and is hidden


class SceneNodes:
    """The objects in one browser's scene; each kind is sent when it is first shown."""

    def __init__(self, client: "ClientHandle", run: ViewedRun, fly_to: Callable[[str], None]) -> None:
        self._client, self._run, self._fly_to = client, run, fly_to
        self._frusta: dict[str, Any] = {}
        self._path: Any = None
        self._cloud: Any = None
        self._cloud_key: tuple | None = None
        self._chosen: str | None = None
        self._frusta_shown = self._path_shown = False
        self._size = _frustum_size(run)
        self._rows = {name: i for i, name in enumerate(run.rec.names)}

    def show_frusta(self, shown: bool) -> None:
        """Show or hide the frames."""
        if shown and not self._frusta:
            self._add_frusta()
        self._frusta_shown = shown
        self.clear_view()

    def clear_view(self) -> None:
        """Hide the frames in whose midst the camera is, and the path where the camera is on it."""
        if not self._frusta and self._path is None:
            return
        at = np.asarray(self._client.camera.position, np.float64)
        away = np.linalg.norm(self._run.cameras.centers.numpy() * self._run.scale - at, axis=1)
        for name, frustum in list(self._frusta.items()):
            apart = bool(away[self._rows[name]] > _NEAR * self._size)
            _set_visible(frustum, self._frusta_shown and apart)
        if self._path is not None:
            _set_visible(self._path, self._path_shown and float(away.min()) > self._size / 2)

    def show_path(self, shown: bool) -> None:
        """Show or hide the line through the cameras, of a rig those of one, in the order of time."""
        rows = path_rows(self._run) if shown and self._path is None else []
        if len(rows) > 1:
            centers = (self._run.cameras.centers[rows] * self._run.scale).numpy().astype(np.float32)
            segments = np.stack([centers[:-1], centers[1:]], 1)
            self._path = self._client.scene.add_line_segments(
                "/path", segments, PATH_COLOR, thickness=2.0, thickness_units="screen"
            )
        self._path_shown = shown
        self.clear_view()

    def show_cloud(self, shown: bool, restored: bool, size: float, crop: CropBox | None) -> None:
        """Show or hide the points, with the water or without, of this size in working units."""
        key = (restored, crop)
        if shown and (self._cloud is None or self._cloud_key != key):
            xyz, colors = self._run.cloud(restored)
            if crop is not None:
                inside = crop.holds(torch.from_numpy(xyz)).numpy()
                xyz, colors = xyz[inside], colors[inside]
            step = max(1, math.ceil(len(xyz) / _MOST_POINTS))
            self._cloud = self._client.scene.add_point_cloud(
                "/points", xyz[::step].astype(np.float32), colors[::step], point_size=size, point_shape="circle",
                precision="float32", point_shading="flat",
            )  # fmt: skip
            self._cloud_key = key
        if self._cloud is not None:
            self._cloud.visible, self._cloud.point_size = shown, size

    def mark(self, name: str) -> None:
        """Mark the frame that was chosen last."""
        for each, color in ((self._chosen, FRAME_COLOR), (name, CHOSEN_COLOR)):
            if each in self._frusta:
                self._frusta[each].color = color
        self._chosen = name

    def outline(self, crop: CropBox | None) -> None:
        """Draw the edges of a crop box, or none."""
        self._client.scene.remove_by_name("/crop")
        if crop is not None:
            self._client.scene.add_line_segments(
                "/crop", _edges(crop), (120, 220, 255), thickness=1.5, thickness_units="screen"
            )

    def _add_frusta(self) -> None:
        run = self._run
        step = max(1, math.ceil(len(run.rec.names) / _MOST_FRUSTA))
        for i in range(0, len(run.rec.names), step):
            name, camera = run.rec.names[i], run.cameras[i]
            frustum = self._client.scene.add_camera_frustum(
                f"/frames/{i}",
                fov=vertical_fov(camera),
                aspect=camera.width / camera.height,
                scale=self._size,
                thickness=1.5,
                thickness_units="screen",
                color=FRAME_COLOR,
                image=run.thumbnail(name),
                format="jpeg",
                wxyz=quaternion_from_rotation(camera.cam2world[0, :3, :3]).numpy(),
                position=(camera.centers[0] * run.scale).numpy(),
                cast_shadow=False,
                receive_shadow=False,
            )
            frustum.on_click(lambda _, name=name: self._fly_to(name))
            self._frusta[name] = frustum


def path_rows(run: ViewedRun) -> list[int]:
    """The registered frames that a line through the cameras leads through: of a rig those of one, in time order."""
    rows = rows_of_one_camera(run.rec.names, run.frames)
    times = run.frames.times_of([run.rec.names[row] for row in rows])
    return [row for _, row in sorted(zip(times, rows, strict=True))]


def _set_visible(node: Any, visible: bool) -> None:
    if node.visible != visible:
        node.visible = visible


def _frustum_size(run: ViewedRun) -> float:
    """A size that leaves frames apart: about the distance of neighbors."""
    centers = (run.cameras.centers * run.scale).numpy()
    if len(centers) < 2:
        return _FRUSTUM[1]
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    return float(np.clip(np.median(steps), *_FRUSTUM))


def view_of(client: "ClientHandle", run: ViewedRun) -> ViewCamera:
    """The camera of a browser as the renderer takes it."""
    camera = client.camera
    R = rotation_from_quaternion(torch.from_numpy(np.asarray(camera.wxyz, np.float64)))
    t = torch.from_numpy(np.asarray(camera.position, np.float64)) / run.scale
    width, height = camera.image_width, max(1, camera.image_height)
    return ViewCamera(pose_from(R, t), float(camera.fov), width / height, max(width, height, 64))


def vertical_fov(camera: Cameras, aspect: float | None = None) -> float:
    """The vertical field of view of a camera, radians; with `aspect`, that of a window that shows all of its image."""
    down = camera.height / (2 * float(camera.K[0, 1, 1]))
    if aspect is not None:
        down = max(down, camera.width / (2 * float(camera.K[0, 0, 0])) / aspect)
    return 2 * math.atan(down)


def _edges(crop: CropBox) -> np.ndarray:
    corners = np.array([[(crop.low, crop.high)[k >> axis & 1][axis] for axis in range(3)] for k in range(8)])
    pairs = [(a, a | 1 << axis) for a in range(8) for axis in range(3) if not a >> axis & 1]
    return corners[np.array(pairs)].astype(np.float32)
