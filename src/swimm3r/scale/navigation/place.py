"""Coordinates of navigation and control points in one local frame, east, north and up in metres of the ground.

Latitude and longitude become exact local metres; so do eastings and northings of a known reference system. Those of an
unknown one are taken as they are. The results carry the projection of the local frame (`Place`).
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from swimm3r.errors import UsageError
from swimm3r.io.navigation.record import Navigation
from swimm3r.scale.navigation.geodesy import Origin, geodetic_from_projected, grid_at, local_from_geodetic, utm_zone
from swimm3r.scale.settings import ScaleSettings, epsg_of


@dataclass(frozen=True)
class Place:
    """A local frame and the reference system it is written in."""

    origin: Origin | None  # None where latitude and longitude are not known
    base: tuple[float, float, float]  # coordinates of the frame's origin in the reference system
    epsg: int | None
    convergence: float = 0.0  # radians, from true north to the system's north
    grid_scale: float = 1.0

    @property
    def to_grid(self) -> Float[np.ndarray, "3 3"]:
        """The turn from true east and north to those of the reference system."""
        cos, sin = np.cos(self.convergence), np.sin(self.convergence)
        return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class LocalNavigation:
    """Navigation whose positions are local metres, and the place of their frame."""

    navigation: Navigation
    place: Place


def localized(navigation: Navigation, settings: ScaleSettings, place: Place | None = None) -> LocalNavigation:
    """The navigation in the local frame around its middle, or in that of a place.

    Raises UsageError where a reference system is asked for that cannot be had.
    """
    navigation = _geodetic(navigation, settings)
    position = navigation.position
    if navigation.frame != "geodetic":
        if place is not None and place.origin is not None:
            raise _other_system()
        place = place or _unprojected(position, settings)
        local = position - np.array(place.base)
        return LocalNavigation(replace(navigation, position=local, frame="local"), place)
    place = place or _projected(Origin(*(float(v) for v in position.mean(0))), settings)
    if place.origin is None:
        raise _other_system()
    local = local_from_geodetic(position, place.origin)
    return LocalNavigation(replace(navigation, position=local, frame="local"), place)


def _geodetic(navigation: Navigation, settings: ScaleSettings) -> Navigation:
    """Projected coordinates of a known system as latitude and longitude; everything else as it is."""
    code = navigation.epsg or (epsg_of(settings.nav_crs) if settings.nav_crs else None)
    if navigation.frame != "projected" or code is None:
        return navigation
    return replace(navigation, position=geodetic_from_projected(navigation.position, code), frame="geodetic")


def _projected(origin: Origin, settings: ScaleSettings) -> Place:
    if settings.crs.lower() == "local":
        return Place(origin, (0.0, 0.0, origin.height), None)
    epsg = epsg_of(settings.crs) or utm_zone(origin.latitude, origin.longitude)
    grid = grid_at(epsg, origin)
    return Place(origin, (grid.easting, grid.northing, origin.height), epsg, grid.convergence, grid.scale)


def _unprojected(position: Float[np.ndarray, "n 3"], settings: ScaleSettings) -> Place:
    if epsg_of(settings.crs) is not None:
        raise UsageError(
            f"the results are to be in {settings.crs}, and the system of the navigation's coordinates is not known",
            cause="a file of eastings and northings does not state its reference system",
            hint="--nav-crs EPSG:n",
        )
    east, north, up = (float(v) for v in np.floor(position.mean(0)))
    return Place(None, (east, north, up), None)


def _other_system() -> UsageError:
    return UsageError(
        "control points and navigation are in different reference systems",
        cause="one has latitude and longitude, the other eastings and northings of an unknown system",
        hint="--nav-crs EPSG:n, the system of the eastings and northings",
    )
