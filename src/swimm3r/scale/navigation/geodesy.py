"""Latitude, longitude and height -> metres east, north and up of a point, exactly; and projected coordinates by pyproj.

    X = (N + h) (cos lat cos lon, cos lat sin lon, (1 - e^2 N / (N + h)) sin lat),   N = a / sqrt(1 - e^2 sin^2 lat)
    (e, n, u) = R(lat0, lon0) (X - X0)                                               WGS 84

Alignment works in this local frame, whose metres are those of a rule on the ground. A projection has other metres and
another north; `grid_at` tells both, so that products land at the right place.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from swimm3r.errors import UsageError

_A, _F = 6_378_137.0, 1 / 298.257223563
_E2 = _F * (2 - _F)
_WGS84 = 4326  # EPSG code; the datum of a national system may lie 100 m and more from it


@dataclass(frozen=True)
class Origin:
    """A point on the ellipsoid's ground: degrees and metres."""

    latitude: float
    longitude: float
    height: float


@dataclass(frozen=True)
class Grid:
    """A projection at a point: its coordinates there, the turn of its north from true north, and its scale."""

    easting: float
    northing: float
    convergence: float  # radians, clockwise from true north to grid north
    scale: float  # metres in the projection per metre on the ground, at the point's height


def local_from_geodetic(geodetic: Float[np.ndarray, "n 3"], origin: Origin) -> Float[np.ndarray, "n 3"]:
    """East, north and up of latitudes, longitudes (degrees) and heights."""
    start = np.array([[origin.latitude, origin.longitude, origin.height]])
    return (_earth_centered(geodetic) - _earth_centered(start)) @ _axes(origin).T


def geodetic_from_local(local: Float[np.ndarray, "n 3"], origin: Origin) -> Float[np.ndarray, "n 3"]:
    """The inverse of `local_from_geodetic`: fixed-point iteration, exact to nanometres near the ground."""
    start = np.array([[origin.latitude, origin.longitude, origin.height]])
    x, y, z = (_earth_centered(start) + local @ _axes(origin)).T
    across = np.hypot(x, y)
    latitude, height = np.arctan2(z, across * (1 - _E2)), np.zeros_like(x)
    for _ in range(12):
        normal = _A / np.sqrt(1 - _E2 * np.sin(latitude) ** 2)
        height = across * np.cos(latitude) + z * np.sin(latitude) - _A**2 / normal
        latitude = np.arctan2(z, across * (1 - _E2 * normal / (normal + height)))
    return np.stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), height], -1)


def utm_zone(latitude: float, longitude: float) -> int:
    """EPSG code of the UTM zone (WGS 84) of a place."""
    zone = int((longitude + 180) % 360 // 6) + 1
    return (32600 if latitude >= 0 else 32700) + zone


def grid_at(epsg: int, origin: Origin) -> Grid:
    """A projected reference system at a place (WGS 84), its datum accounted for.

    Raises UsageError where pyproj is missing or knows no such system.
    """
    crs, transformer = _projection(epsg)
    easting, northing = transformer.transform(origin.longitude, origin.latitude)
    factors = _pyproj().Proj(crs).get_factors(origin.longitude, origin.latitude)
    if not np.isfinite([easting, northing]).all():
        raise UsageError(
            f"EPSG:{epsg} does not cover latitude {origin.latitude:.4f}, longitude {origin.longitude:.4f}",
            cause="the system of another region",
            hint=f"--crs EPSG:{utm_zone(origin.latitude, origin.longitude)}, the UTM zone there; or --crs auto",
        )
    on_ground = _A / (_A + origin.height)  # lengths at a depth are shorter on the ellipsoid's way down
    return Grid(
        easting, northing, float(np.radians(factors.meridian_convergence)), float(factors.meridional_scale) * on_ground
    )


def geodetic_from_projected(projected: Float[np.ndarray, "n 3"], epsg: int) -> Float[np.ndarray, "n 3"]:
    """Latitudes, longitudes (WGS 84) and heights of eastings, northings and heights."""
    _, transformer = _projection(epsg)
    longitude, latitude = transformer.transform(projected[:, 0], projected[:, 1], direction="INVERSE")
    return np.stack([latitude, longitude, projected[:, 2]], -1)


def _projection(epsg: int) -> tuple[Any, Any]:
    pyproj = _pyproj()
    try:
        crs = pyproj.CRS.from_epsg(epsg)
    except pyproj.exceptions.CRSError as error:
        raise UsageError(
            f"EPSG:{epsg} is no reference system that pyproj knows", cause="a slip in the number", hint="--crs auto"
        ) from error
    if not crs.is_projected or any(axis.unit_name not in ("metre", "meter") for axis in crs.axis_info[:2]):
        raise UsageError(
            f"EPSG:{epsg} ({crs.name}) is no projected reference system in metres",
            cause="a geographic system, as EPSG:4326, has degrees",
            hint="--crs auto for the UTM zone, or the projected system of the region",
        )
    return crs, pyproj.Transformer.from_crs(_WGS84, crs, always_xy=True)


def _pyproj() -> Any:
    try:
        import pyproj
    except ModuleNotFoundError as error:
        raise UsageError(
            "coordinates of a map need pyproj, which is not installed",
            cause="Swimm3R was installed without its extra [geo]",
            hint="pip install 'swimm3r[geo]'; or --crs local, metres east and north of the first position",
        ) from error
    return pyproj


def _earth_centered(geodetic: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    latitude, longitude = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1])
    normal = _A / np.sqrt(1 - _E2 * np.sin(latitude) ** 2)
    across = (normal + geodetic[:, 2]) * np.cos(latitude)
    along = (normal * (1 - _E2) + geodetic[:, 2]) * np.sin(latitude)
    return np.stack([across * np.cos(longitude), across * np.sin(longitude), along], -1)


def _axes(origin: Origin) -> Float[np.ndarray, "3 3"]:
    """Rows: east, north and up of a place in earth-centered axes."""
    (sin_b, cos_b), (sin_l, cos_l) = (
        (np.sin(angle), np.cos(angle)) for angle in np.radians([origin.latitude, origin.longitude])
    )
    return np.array(
        [[-sin_l, cos_l, 0.0], [-sin_b * cos_l, -sin_b * sin_l, cos_b], [cos_b * cos_l, cos_b * sin_l, sin_b]]
    )
