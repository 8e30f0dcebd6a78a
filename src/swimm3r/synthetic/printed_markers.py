"""Printed markers on level plates above the seafloor: ArUco 4x4 of 50, ids in the order of the camera's path.

A plate lies where the ground beside the path is flattest, just above its highest point, and is rendered exactly where
the rays of a frame meet its plane.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from swimm3r.cameras import Cameras, directions, project
from swimm3r.synthetic.plain import Plain
from swimm3r.synthetic.seafloor import SUN, Seafloor, height_at

FAMILY = "aruco-4x4-50"
_BORDER = 1.5  # side of the plate by that of the marker's black square
_CELLS = 6  # of the black square, its frame included
_ASIDE = 0.35  # metres from the path, left and right in turn
_ABOVE = 0.005  # metres between plate and ground
_SEARCH = 0.4  # of a part of the path, before and behind its middle, where flat ground is looked for
_CANDIDATES = 16  # places there, before and behind
_WHITE, _BLACK = 0.55, 0.03  # albedo
_LIGHT = 0.55 + 1.05 * float(SUN[2])
_SAMPLES = 6  # per pixel and axis


@dataclass(frozen=True)
class Plate:
    """A printed marker; metres."""

    marker: int
    center: tuple[float, float, float]
    turn: float  # radians, counter-clockwise from above
    size: float  # of the black square

    @property
    def corners(self) -> Float[np.ndarray, "4 3"]:
        """Corners of the black square: the marker's first one, then clockwise as seen from above."""
        return self._square(self.size)

    def _square(self, side: float) -> Float[np.ndarray, "4 3"]:
        flat = side / 2 * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
        cos, sin = np.cos(self.turn), np.sin(self.turn)
        return flat @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]) + np.array(self.center)


def plates_along(
    floor: Seafloor | Plain, path: Float[np.ndarray, "f 3"], count: int, size: float, seed: int
) -> list[Plate]:
    """Markers beside a path of the camera, one for each of `count` parts of its frames, where the ground is flat."""
    rng = np.random.default_rng([seed, 7])
    plates: list[Plate] = []
    for marker in range(count):
        turn, last = float(rng.uniform(0, 6.28)), len(path) - 1
        near = np.linspace(marker + 0.5 - _SEARCH, marker + 0.5 + _SEARCH, 2 * _CANDIDATES + 1)
        frames = np.unique((near * len(path) / count).round().astype(int).clip(0, last))
        places = [_beside(path, int(i), side) for i in frames for side in (-1, 1)]
        free = [place for place in places if _clear_of(place, plates, size)]
        _, top, (x, y) = min((*_relief(floor, place, size), place) for place in free or places)
        plates.append(Plate(marker, (x, y, top + _ABOVE), turn, size))
    return plates


def _beside(path: Float[np.ndarray, "f 3"], i: int, side: int) -> tuple[float, float]:
    """The place beside frame i of a path, to its right or its left."""
    ahead = path[min(i + 1, len(path) - 1), :2] - path[max(i - 1, 0), :2]
    x, y = path[i, :2] + _ASIDE * side * np.array([ahead[1], -ahead[0]]) / max(float(np.linalg.norm(ahead)), 1e-9)
    return float(x), float(y)


def _clear_of(place: tuple[float, float], plates: Sequence[Plate], size: float) -> bool:
    return all(np.hypot(place[0] - p.center[0], place[1] - p.center[1]) > 2 * _BORDER * size for p in plates)


def _relief(floor: Seafloor | Plain, place: tuple[float, float], size: float) -> tuple[float, float]:
    """Height by which the ground below a plate varies, and its highest point there; metres."""
    reach = np.linspace(-_BORDER, _BORDER, 15) * size * 0.75
    below = height_at(floor.around(*place), *np.meshgrid(place[0] + reach, place[1] + reach))
    return float(np.ptp(below)), float(below.max())


def with_plates(
    radiance: Float[np.ndarray, "h w 3"], z_depth: Float[np.ndarray, "h w"], camera: Cameras, plates: Sequence[Plate]
) -> tuple[Float[np.ndarray, "h w 3"], Float[np.ndarray, "h w"]]:
    """Linear radiance and z depth of a frame with the plates that it shows."""
    radiance, z_depth = radiance.copy(), z_depth.copy()
    for plate in plates:
        window = _window(camera, plate)
        if window is None:
            continue
        rows, columns = window
        albedo, _ = _seen(camera, plate, _samples(columns), _samples(rows))
        middle, z = _seen(camera, plate, columns + 0.5, rows + 0.5)
        at = np.ix_(rows, columns)
        visible = (z_depth[at] == 0) | (z < z_depth[at]) | ~np.isfinite(middle)
        radiance[at] = np.where(visible[..., None], _over(radiance[at], albedo), radiance[at])
        z_depth[at] = np.where(visible & np.isfinite(middle), z, z_depth[at])
    return radiance, z_depth


def plates_from_above(
    radiance: Float[np.ndarray, "rows columns 3"],
    height: Float[np.ndarray, "rows columns"],
    x: Float[np.ndarray, " columns"],
    y: Float[np.ndarray, " rows"],
    plates: Sequence[Plate],
) -> tuple[Float[np.ndarray, "rows columns 3"], Float[np.ndarray, "rows columns"]]:
    """Linear radiance and heights of cells with these middles, evenly spaced, with the plates that lie there."""
    radiance, height = radiance.copy(), height.copy()
    steps = x[1] - x[0], y[1] - y[0]
    for plate in plates:
        reach = _BORDER * plate.size / np.sqrt(2) + abs(steps[0])
        columns = np.flatnonzero(np.abs(x - plate.center[0]) < reach)
        rows = np.flatnonzero(np.abs(y - plate.center[1]) < reach)
        if not len(columns) or not len(rows):
            continue
        at = np.ix_(rows, columns)
        middles = x[columns] - plate.center[0], y[rows] - plate.center[1]
        fine = (m[0] + (_samples(np.arange(len(m))) - 0.5) * step for m, step in zip(middles, steps, strict=True))
        albedo, middle = _albedo(plate, *np.meshgrid(*fine)), _albedo(plate, *np.meshgrid(*middles))
        visible = (height[at] < plate.center[2]) | ~np.isfinite(middle)
        radiance[at] = np.where(visible[..., None], _over(radiance[at], albedo), radiance[at])
        height[at] = np.where(visible & np.isfinite(middle), plate.center[2], height[at])
    return radiance, height


def _samples(pixels: Int[np.ndarray, " n"]) -> Float[np.ndarray, " m"]:
    """The places of samples along one side of pixels, evenly spread in each."""
    return (pixels[:, None] + (np.arange(_SAMPLES) + 0.5) / _SAMPLES).ravel()


def _over(radiance: Float[np.ndarray, "h w 3"], albedo: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "h w 3"]:
    """Radiance of pixels behind a plate whose albedo their samples have; NaN beside it."""
    rows, columns = radiance.shape[:2]
    shape = (rows, _SAMPLES, columns, _SAMPLES)
    cover = np.isfinite(albedo).reshape(shape).mean((1, 3))
    light = _LIGHT * np.nansum(albedo.reshape(shape), (1, 3)) / _SAMPLES**2
    return (1 - cover)[..., None] * radiance + light[..., None]


def _window(camera: Cameras, plate: Plate) -> tuple[np.ndarray, np.ndarray] | None:
    """Rows and columns that may show a plate; None where it is out of view."""
    corners = torch.from_numpy(plate._square(_BORDER * plate.size))
    pixels, z = project(camera, corners[None])
    if not bool((z > 0.05).all()):
        return None
    low, high = pixels[0].min(0).values.numpy(), pixels[0].max(0).values.numpy()
    columns = np.arange(max(0, int(low[0]) - 1), min(camera.width, int(high[0]) + 2))
    rows = np.arange(max(0, int(low[1]) - 1), min(camera.height, int(high[1]) + 2))
    return (rows, columns) if len(rows) and len(columns) else None


def _seen(
    camera: Cameras, plate: Plate, x: Float[np.ndarray, " m"], y: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, "n m"]]:
    """Albedo of the plate through a grid of pixels (NaN beside it), and the z depth of its plane there."""
    pixels = torch.from_numpy(np.stack(np.meshgrid(x, y), -1).reshape(1, -1, 2))
    pose = camera.cam2world[0].double().numpy()
    rays = directions(camera, pixels)[0].numpy() @ pose[:3, :3].T
    down = np.where(np.abs(rays[:, 2]) < 1e-9, 1e-9, rays[:, 2])
    z = (plate.center[2] - pose[2, 3]) / down
    east, north = (pose[:3, 3] + z[:, None] * rays)[:, :2].T - np.array(plate.center[:2])[:, None]
    shape = (len(y), len(x))
    albedo = np.where(z > 0, _albedo(plate, east, north), np.nan)
    return albedo.reshape(shape), z.reshape(shape)


def _albedo(plate: Plate, east: Float[np.ndarray, "*n"], north: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Albedo of a plate at distances from its center, metres; NaN beside it."""
    cos, sin = np.cos(plate.turn), np.sin(plate.turn)
    u, v = (cos * east + sin * north) / plate.size, (cos * north - sin * east) / plate.size
    on_plate = np.maximum(np.abs(u), np.abs(v)) <= _BORDER / 2
    column, row = (np.floor((value + 0.5) * _CELLS).astype(int) for value in (u, -v))
    inside = (column >= 0) & (column < _CELLS) & (row >= 0) & (row < _CELLS)
    cells = _cells(plate.marker)[row.clip(0, _CELLS - 1), column.clip(0, _CELLS - 1)]
    return np.where(on_plate, np.where(inside & ~cells, _BLACK, _WHITE), np.nan)


def _cells(marker: int) -> np.ndarray:
    """The white cells of a marker, its black frame included."""
    from cv2 import aruco

    dictionary = aruco.getPredefinedDictionary(aruco.DICT_4X4_50)
    return aruco.generateImageMarker(dictionary, marker, _CELLS) > 127
