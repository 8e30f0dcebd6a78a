"""Names and units of a table's columns: "depth", "Depth [m]", "heading_deg", "lon (rad)", "pressure_dbar".

A unit in brackets, or after the last underscore, wins; without one a column has the unit of its kind: metres, degrees,
seconds, and bar for pressure.
"""

import math
import re
from dataclasses import dataclass

_ALIASES = {
    "time": ("time", "timestamp", "datetime", "utc", "ts", "t", "date_time", "gps_time", "unix_time", "time_utc"),
    "date": ("date", "day"),
    "role": ("role",),
    "source": ("source",),
    "target": ("target",),
    "name": ("name", "image", "file", "filename", "frame", "photo", "label", "point"),
    "latitude": ("latitude", "lat"),
    "longitude": ("longitude", "lon", "long", "lng"),
    "easting": ("easting", "east", "e", "utm_e", "x"),
    "northing": ("northing", "north", "n", "utm_n", "y"),
    "depth": ("depth", "water_depth", "vehicle_depth"),
    "height": ("height", "up", "z", "elevation", "ellipsoidal_height"),
    "pressure": ("pressure", "press"),
    "altitude": ("altitude", "alt", "altimeter", "dvl_altitude", "range_to_bottom", "height_above_bottom"),
    "heading": ("heading", "hdg", "yaw", "course_heading"),
    "pitch": ("pitch",),
    "roll": ("roll",),
    "qx": ("qx",),
    "qy": ("qy",),
    "qz": ("qz",),
    "qw": ("qw",),
    "std_east": ("std_east", "easting_std", "east_std", "sigma_e", "std_e", "x_std", "std_x", "sigma_x", "lon_std"),
    "std_north": ("std_north", "northing_std", "north_std", "sigma_n", "std_n", "y_std", "std_y", "sigma_y", "lat_std"),
    "std_up": ("std_up", "depth_std", "height_std", "sigma_u", "std_u", "z_std", "std_z", "sigma_z", "std_depth"),
    "std_position": ("std", "position_std", "std_position", "sigma", "accuracy"),
    "std_heading": ("std_heading", "heading_std", "yaw_std", "sigma_heading"),
    "std_pitch": ("std_pitch", "pitch_std", "sigma_pitch"),
    "std_roll": ("std_roll", "roll_std", "sigma_roll"),
}
_KINDS = {alias: kind for kind, aliases in _ALIASES.items() for alias in aliases}
_LENGTH = {"m": 1.0, "cm": 0.01, "mm": 0.001, "km": 1000.0, "ft": 0.3048, "metre": 1.0, "meter": 1.0, "metres": 1.0}
_ANGLE = {"deg": 1.0, "degrees": 1.0, "degree": 1.0, "\u00b0": 1.0, "rad": 180 / math.pi, "radians": 180 / math.pi}
_TIME = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "utc": 1.0}
_PRESSURE = {"bar": 1.0, "dbar": 0.1, "mbar": 1e-3, "kpa": 0.01, "pa": 1e-5, "psi": 0.0689475729, "hpa": 1e-3}
_ANGLES = ("latitude", "longitude", "heading", "pitch", "roll", "std_heading", "std_pitch", "std_roll")


@dataclass(frozen=True)
class Column:
    """The kind of a column, the factor to its kind's unit, and whether the name states the unit."""

    kind: str
    factor: float
    unit: str | None


def column(title: str) -> Column | None:
    """The kind and unit that a title names; None for one that is not known. Raises ValueError for a foreign unit."""
    title = title.strip().strip('"').strip("\ufeff").lower()
    bracketed = re.fullmatch(r"(.*?)\s*[\[(]\s*([^\])]+?)\s*[\])]", title)
    name, unit = (bracketed[1], bracketed[2]) if bracketed else (title, None)
    name = re.sub(r"[\s./-]+", "_", name.strip()).strip("_")
    if unit is None and name not in _KINDS and "_" in name:
        stem, last = name.rsplit("_", 1)
        if stem in _KINDS and last in _units(_KINDS[stem]):
            name, unit = stem, last
    kind = _KINDS.get(name)
    if kind is None:
        return None
    units = _units(kind)
    if unit is not None and unit not in units:
        raise ValueError(f"the unit of {title!r} is {unit}; known are {', '.join(units) or 'none'}")
    return Column(kind, 1.0 if unit is None else units[unit], unit)


def _units(kind: str) -> dict[str, float]:
    """The units that a kind may have, as factors to its own."""
    if kind in _ANGLES:
        return _ANGLE
    if kind == "time":
        return _TIME
    if kind == "pressure":
        return _PRESSURE
    return {} if kind in ("name", "date", "role", "source", "target", "qx", "qy", "qz", "qw") else _LENGTH
