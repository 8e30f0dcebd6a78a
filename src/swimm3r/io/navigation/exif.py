"""Positions that images carry in their EXIF block -> navigation of named images."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from swimm3r.io.image_header import exif_ifd
from swimm3r.io.navigation.record import Navigation

_GPS = 0x8825  # the GPS part of EXIF
_LATITUDE_REF, _LATITUDE, _LONGITUDE_REF, _LONGITUDE, _ALTITUDE_REF, _ALTITUDE = range(1, 7)


def read_exif(folder: Path, images: Sequence[Path]) -> Navigation:
    """The positions of the images that have one. Raises ValueError where fewer than 2 do."""
    found = [(path, place) for path in images if (place := _place(path)) is not None]
    if len(found) < 2:
        raise ValueError(f"{len(found)} of its {len(images)} images have a GPS position")
    position = np.array([place for _, place in found])
    unknown = np.isnan(position[:, 2])
    position[unknown, 2] = 0.0
    std = np.full(position.shape, np.nan)
    std[unknown, 2] = np.inf
    names = tuple(path.relative_to(folder).as_posix() for path, _ in found)
    time = np.arange(len(found), dtype=np.float64)
    return Navigation(folder, "geodetic", position, "names", time, names, std=std if unknown.any() else None)


def _place(path: Path) -> tuple[float, float, float] | None:
    """Latitude, longitude and height (NaN where it is not told); None without a fix, and of damaged images."""
    gps = exif_ifd(path, _GPS)
    try:
        latitude, longitude = (_decimal(gps[key]) for key in (_LATITUDE, _LONGITUDE))
        height = float(gps[_ALTITUDE]) if _ALTITUDE in gps else math.nan
    except (KeyError, TypeError, ValueError, ArithmeticError):
        return None
    if not (math.isfinite(latitude) and math.isfinite(longitude) and (latitude or longitude)):
        return None  # numbers over zero, or zeros: the receiver had no fix
    latitude *= -1 if gps.get(_LATITUDE_REF) == "S" else 1
    longitude *= -1 if gps.get(_LONGITUDE_REF) == "W" else 1
    below = gps.get(_ALTITUDE_REF) in (1, b"\x01")
    return latitude, longitude, height * (-1 if below else 1) if math.isfinite(height) else math.nan


def _decimal(parts: Any) -> float:
    """Degrees of degrees, minutes and seconds, of which the last may be left out. Raises TypeError for no sequence."""
    degrees, minutes, seconds = (*map(float, parts), 0.0, 0.0)[:3]
    return degrees + minutes / 60 + seconds / 3600
