"""Positions and attitude of a vehicle over time, as a file states them.

Attitude is a rotation from the axes of the vehicle (x forward, y starboard, z down) to east, north and up:

    R = [[0, 1, 0], [1, 0, 0], [0, 0, -1]] Rz(heading) Ry(pitch) Rx(roll)

heading clockwise from north, pitch bow up, roll starboard down.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from swimm3r.errors import InputError

Frame = Literal["geodetic", "projected", "local"]
Clock = Literal["utc", "clip", "names"]
"""Seconds since 1970; seconds of the clip; or none, where rows are those of named images."""

PORT_UP = np.diag([1.0, -1.0, -1.0])  # axes of ROS's vehicles from those above: starboard and down
_EARLY, _FAR = 631_152_000.0, 4_102_444_800.0  # 1990 and 2100 in seconds since 1970
_UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
_NED_TO_ENU = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])


@dataclass(frozen=True)
class Navigation:
    """Rows in the order of time. Raises ValueError where their numbers cannot be."""

    path: Path
    frame: Frame
    position: Float[np.ndarray, "n 3"]  # latitude, longitude (degrees), height; or easting, northing, height (m)
    clock: Clock
    time: Float[np.ndarray, " n"]  # seconds
    names: tuple[str, ...] | None = None  # images that the rows belong to
    epsg: int | None = None  # of projected coordinates, where it is known
    std: Float[np.ndarray, "n 3"] | None = None  # east, north, up, metres; infinite where a coordinate is not known
    attitude: Float[np.ndarray, "n 3 3"] | None = None  # vehicle to east, north, up; NaN in rows without
    attitude_std: Float[np.ndarray, "n 3"] | None = None  # heading, pitch, roll, degrees
    altitude: Float[np.ndarray, " n"] | None = None  # above the bottom, metres; NaN in rows without

    def __len__(self) -> int:
        return len(self.position)

    @property
    def has_heights_alone(self) -> bool:
        """Return whether east and north are known in no row, as of dive computers."""
        return self.std is not None and bool(np.isinf(self.std[:, :2]).all())

    def rows(self, which: Int[np.ndarray, " k"] | Bool[np.ndarray, " n"]) -> "Navigation":
        """Some of the rows."""
        index = np.flatnonzero(which) if which.dtype == bool else which
        names = None if self.names is None else tuple(self.names[int(i)] for i in index)
        chosen = {
            name: None if (values := getattr(self, name)) is None else values[index]
            for name in ("std", "attitude", "attitude_std", "altitude")
        }
        return replace(self, position=self.position[index], time=self.time[index], names=names, **chosen)


def in_time_order(navigation: Navigation) -> Navigation:
    """The rows sorted by time, the first of each moment; rows of named images stay as they are.

    Raises InputError for coordinates that cannot be, with the reason, and for fewer than 2 rows.
    """
    check_coordinates(navigation)
    if len(navigation) < 2:
        raise InputError(
            f"{navigation.path} holds {len(navigation)} position{'s' * (len(navigation) != 1)}",
            cause="the file is cut off, or holds another part of the dive",
            hint="navigation of the whole clip, at least two positions",
        )
    if navigation.clock == "names":
        return navigation
    _, first = np.unique(navigation.time, return_index=True)
    return navigation.rows(first)


def vehicle_attitude(
    heading: Float[np.ndarray, " n"], pitch: Float[np.ndarray, " n"], roll: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3 3"]:
    """Rotations from the axes of the vehicle to east, north, up; angles in degrees."""
    from scipy.spatial.transform import Rotation

    known = np.isfinite(heading) & np.isfinite(pitch) & np.isfinite(roll)
    out = np.full((len(heading), 3, 3), np.nan)
    if known.any():
        angles = np.stack([heading, pitch, roll], -1)[known]
        out[known] = _NED_TO_ENU @ Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
    return out


def check_coordinates(navigation: Navigation) -> None:
    """Raise InputError for coordinates that cannot be, with the reason."""
    path, position = navigation.path, navigation.position
    if not np.isfinite(position).all() or not np.isfinite(navigation.time).all():
        raise InputError(
            f"{path} has positions or times that are not finite numbers",
            cause="cells such as NaN or inf",
            hint="leave such rows out",
        )
    _check_unit_of_times(navigation)
    if navigation.frame != "geodetic" or not len(position):
        return
    latitude, longitude = position[:, 0], position[:, 1]
    if (np.abs(latitude) > 90).any():
        swapped = (np.abs(longitude) <= 90).all()
        raise InputError(
            f"{path} has the latitude {latitude[np.argmax(np.abs(latitude))]:g}, beyond 90 degrees",
            cause="the columns of latitude and longitude are swapped" if swapped else "another unit than degrees",
            hint="exchange the names of the two columns" if swapped else "latitude and longitude in decimal degrees",
        )
    if (np.abs(longitude) > 360).any():
        raise InputError(
            f"{path} has the longitude {longitude[np.argmax(np.abs(longitude))]:g}, beyond 360 degrees",
            cause="another unit than degrees, or easting and northing under the names of longitude and latitude",
            hint="decimal degrees, or the columns easting and northing",
        )


def _check_unit_of_times(navigation: Navigation) -> None:
    """Raise InputError for times beyond the year 2100, which are no seconds."""
    latest = float(np.abs(navigation.time).max(initial=0.0))
    if latest < _FAR:
        return
    unit = next((name for name, factor in _UNITS.items() if _EARLY < latest * factor < _FAR), None)
    raise InputError(
        f"{navigation.path} has the time {latest:.12g} s, beyond the year 2100",
        cause=f"{unit} since 1970 where seconds are expected" if unit else "a date written as one number",
        hint="a table whose column states the unit, as time [ms], [us] or [ns]; or dates such as 2026-05-14T09:30:00",
    )
