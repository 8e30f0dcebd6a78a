"""The place of a run on the ground: its unit, the direction up, and the coordinates of its origin, in double precision.

    local = rotation (scale x_run)          metres; x east-like, y north-like, z up; float32 is enough for it
    crs   = origin + (g, g, 1) local        coordinates of a projected reference system, metres; float64 only

x_run are the coordinates that the files of the run hold, whose origin is the local origin. g, `grid_scale`, is the
length in the projection of a metre on the ground: 0.9996 to 1.001 for UTM. Heights are negative water depths.
RUN/georeference.json keeps the record; `swimm3r scale` writes it.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from swimm3r.geometry import DegenerateAlignmentError
from swimm3r.io.files.atomic import write_text
from swimm3r.io.files.damage import Remedy
from swimm3r.io.files.json_file import read_json
from swimm3r.scene.reconstruction import Reconstruction

GEOREFERENCE = "georeference.json"
SCHEMA = 1

Vector: TypeAlias = tuple[float, float, float]
_REMEDY = Remedy("swimm3r scale RUN with the scale bars, markers or navigation it was made from writes it again")
_PLANE_ROUNDS = 20  # of reweighting; each halves the pull of rocks and fish, and 10 rounds settle a real seabed
_FLAT = 0.5  # thickness by width, above which the points show no ground plane


@dataclass(frozen=True)
class Georeference:
    """Unit, axes and origin of the coordinates in a run's files. Raises ValueError where the rotation is none."""

    epsg: int | None  # projected reference system in metres; None: a local frame
    origin: Vector  # easting, northing and height (= -water depth) of the local origin
    rotation: tuple[Vector, Vector, Vector]  # rows: local east, north and up in the axes of the run
    scale: float | None  # metres per unit of the run's files; None: the unit is not known
    scale_std: float | None = None  # relative standard deviation of the scale
    sources: tuple[str, ...] = ()  # of scale and place, as "navigation" or "marker 3"
    origin_std: Vector | None = None  # metres
    rotation_std_deg: Vector | None = None  # about local east, north and up
    grid_scale: float = 1.0  # metres in the projection per metre on the ground
    geodetic: tuple[float, float] | None = None  # latitude and longitude of the origin, WGS 84 degrees
    schema: int = SCHEMA

    def __post_init__(self) -> None:
        R = self.R
        if not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0:
            raise ValueError("rotation is no rotation matrix")
        for name, value in (("scale", self.scale), ("grid_scale", self.grid_scale)):
            if value is not None and not value > 0:
                raise ValueError(f"{name} is above 0, got {value}")
        if self.scale_std is not None and self.scale_std < 0:
            raise ValueError(f"scale_std is at least 0, got {self.scale_std}")
        if self.schema != SCHEMA:
            raise ValueError(f"schema {self.schema}; this version reads {SCHEMA}")

    @property
    def R(self) -> Float[np.ndarray, "3 3"]:
        """The rotation from the axes of the run to local ones."""
        return np.array(self.rotation, np.float64)

    @property
    def up(self) -> Float[np.ndarray, "3"]:
        """Up in the axes of the run."""
        return self.R[2]

    @property
    def unit(self) -> str:
        """The unit of local coordinates: metres, or units of the run where its scale is not known."""
        return "units" if self.scale is None else "m"

    def to_local(self, run: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
        """Local coordinates of points in the files of the run."""
        return (self.scale or 1.0) * np.asarray(run, np.float64) @ self.R.T

    def from_local(self, local: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
        """Points in the coordinates of the run's files from local ones."""
        return np.asarray(local, np.float64) @ self.R / (self.scale or 1.0)

    def to_crs(self, run: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
        """Easting, northing and height of points in the files of the run."""
        return np.array(self.origin) + self.to_local(run) * self._grid

    def from_crs(self, crs: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3"]:
        """Points in the coordinates of the run's files from easting, northing and height."""
        return self.from_local((np.asarray(crs, np.float64) - np.array(self.origin)) / self._grid)

    @property
    def _grid(self) -> Float[np.ndarray, "3"]:
        return np.array([self.grid_scale, self.grid_scale, 1.0])


def save_georeference(folder: str | Path, georeference: Georeference) -> None:
    """Write RUN/georeference.json, whole or not at all."""
    write_text(Path(folder) / GEOREFERENCE, json.dumps(asdict(georeference), indent=2) + "\n")


def load_georeference(folder: str | Path) -> Georeference | None:
    """The georeference of a run, None where it has none. Raises InputError where the file is damaged."""
    path = Path(folder) / GEOREFERENCE
    return read_json(path, Georeference, _REMEDY) if path.is_file() else None


def local_georeference(rec: Reconstruction) -> Georeference:
    """The frame of a run that nothing georeferences: its own origin, and up as the scene shows it."""
    rotation = up_from_scene(rec)
    rows: list[Vector] = [(float(x), float(y), float(z)) for x, y, z in rotation]
    return Georeference(
        epsg=None,
        origin=(0.0, 0.0, 0.0),
        rotation=(rows[0], rows[1], rows[2]),
        scale=1.0 if rec.metric else None,
        sources=("scene",),
    )


def up_from_scene(rec: Reconstruction) -> Float[np.ndarray, "3 3"]:
    """The rotation from the axes of a run to local ones with z up, from its points and cameras alone.

    Up is against the gravity that the camera measured, where it did; else the normal of the ground, a robust plane
    through the sparse points, on the side of the cameras. Where the points are no plane, as around a wreck, it is
    opposite to the mean camera's y axis. The x axis is the mean camera's,
    turned level, so that a view from above lies as the frames do. Raises DegenerateAlignmentError where neither shows
    a direction.
    """
    poses = rec.cameras.cam2world.double().numpy()
    up = _ground_normal(rec.points.xyz.double().numpy(), poses) if rec.up is None else _unit(np.array(rec.up))
    if up is None:
        up = _unit(-poses[:, :3, 1].mean(0))
    level = [axis - up * (axis @ up) for axis in (*poses[:, :3, :2].mean(0).T, *np.eye(3))]
    east = next((_unit(axis) for axis in level if np.linalg.norm(axis) > 0.1), None)
    if up @ up == 0 or east is None:
        raise DegenerateAlignmentError("neither the points nor the cameras of the run show which way is up")
    return np.stack([east, np.cross(up, east), up])


def _ground_normal(points: Float[np.ndarray, "p 3"], poses: Float[np.ndarray, "c 4 4"]) -> np.ndarray | None:
    """The normal of a robust plane through points, towards the cameras; None where the points lie on no plane."""
    if len(points) < 3:
        return None
    weights = np.ones(len(points))
    for _ in range(_PLANE_ROUNDS):
        center = weights @ points / weights.sum()
        spread = (points - center) * weights[:, None] ** 0.5
        variances, axes = np.linalg.eigh(spread.T @ spread / weights.sum())
        height = (points - center) @ axes[:, 0]
        weights = 1 / (1 + (height / (1.5 * np.median(np.abs(height)) + 1e-12)) ** 2)
    if not variances[0] < _FLAT**2 * variances[1]:
        return None
    normal = axes[:, 0]
    return normal * np.sign(np.mean((poses[:, :3, 3] - center) @ normal) or 1.0)


def _unit(vector: np.ndarray) -> np.ndarray:
    """The vector at length 1; one too short to show a direction is 0."""
    length = float(np.linalg.norm(vector))
    return vector / length if length > 0.1 else np.zeros_like(vector)
