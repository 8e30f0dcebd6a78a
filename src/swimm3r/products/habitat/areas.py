"""Polygons and lines of a GeoJSON file (RFC 7946), in the local frame of a run.

Coordinates are those of the file's `crs` member, as QGIS writes it, else of the map's own system; longitudes and
latitudes without such a member, as the RFC has them, are recognized by their range where the map is projected.
"""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from swimm3r.errors import InputError
from swimm3r.io.files.damage import Remedy, damaged, guard
from swimm3r.products.packages import geo_package
from swimm3r.scene.georeference import Georeference

Ring = Float[np.ndarray, "n 2"]
_REMEDY = Remedy(
    "a GeoJSON FeatureCollection of Polygon, MultiPolygon, LineString or MultiLineString, as QGIS exports it",
    cause="the file is of another format or cut off",
    fault="cannot be read as polygons and lines",
)
_WGS84 = 4326


@dataclass(frozen=True)
class Area:
    """One polygon: rings, local; holes are the further rings of a part."""

    name: str
    parts: tuple[tuple[Ring, ...], ...]

    @property
    def bounds(self) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
        """South-west and north-east corner."""
        outer = np.concatenate([part[0] for part in self.parts])
        return outer.min(0), outer.max(0)

    @property
    def exact_area(self) -> float:
        """Planar area of the parts without their holes."""
        return sum(_area(part[0]) - sum(_area(hole) for hole in part[1:]) for part in self.parts)


@dataclass(frozen=True)
class Line:
    """One line, local."""

    name: str
    nodes: Ring


def read_areas(path: Path, place: Georeference) -> tuple[tuple[Area, ...], tuple[Line, ...]]:
    """The polygons and the lines of a file, each with a name of its own.

    Raises InputError where the file holds none, or is of a reference system that the run cannot be related to.
    """
    with guard(path, _REMEDY):
        document = json.loads(path.read_text(encoding="utf-8-sig"))
        try:
            shapes = list(_shapes(document))
            epsg = _declared(document)
        except (TypeError, AttributeError) as error:  # lists and objects where others belong
            raise ValueError("its coordinates or its crs are not arranged as GeoJSON has them") from error
    if not shapes:
        raise damaged(path, "it holds no polygon and no line", _REMEDY)
    every = np.concatenate([ring for _, _, parts in shapes for part in parts for ring in part])
    to_local = _converter(path, epsg, every, place)
    names = _distinct([name for name, _, _ in shapes])
    areas, lines = [], []
    for name, (_, kind, parts) in zip(names, shapes, strict=True):
        local = [tuple(to_local(ring) for ring in part) for part in parts]
        if kind == "polygon":
            areas.append(Area(name, tuple(local)))
        else:
            lines += [Line(name if len(local) == 1 else f"{name} {k}", part[0]) for k, part in enumerate(local, 1)]
    return tuple(areas), tuple(lines)


def _shapes(document: Any) -> Iterator[tuple[str, str, list[list[Ring]]]]:
    """Name, kind and parts of every shape. Raises ValueError and KeyError where it is no GeoJSON."""
    if not isinstance(document, dict):
        raise ValueError("an object was expected")
    kind = document.get("type")
    features = document["features"] if kind == "FeatureCollection" else [document]
    for number, feature in enumerate(features, 1):
        if not isinstance(feature, dict):
            raise ValueError(f"feature {number} is no object")
        geometry = feature["geometry"] if feature.get("type") == "Feature" else feature
        properties = feature.get("properties") or {}
        name = properties.get("name") if isinstance(properties, dict) else None
        name = str(name if name is not None else feature.get("id", number))
        if geometry is None or geometry.get("coordinates") == []:  # empty, which RFC 7946 has for null
            continue
        yield name, *_parts(geometry, name)


def _parts(geometry: dict[str, Any], name: str) -> tuple[str, list[list[Ring]]]:
    at = geometry.get("coordinates")
    match geometry.get("type"):
        case "Polygon":
            return "polygon", [_rings(at, 3)]
        case "MultiPolygon":
            return "polygon", [_rings(part, 3) for part in _some(at)]
        case "LineString":
            return "line", [_rings([at], 2)]
        case "MultiLineString":
            return "line", [_rings([part], 2) for part in _some(at)]
        case other:
            raise ValueError(f"{name} is a {other}; polygons and lines were expected")


def _some(parts: Any) -> list[Any]:
    if not isinstance(parts, list) or not parts:
        raise ValueError("a polygon or a line has no coordinates")
    return parts


def _rings(rings: Any, least: int) -> list[Ring]:
    found = []
    for ring in _some(rings):
        nodes = np.array([[float(value) for value in node[:2]] for node in ring], np.float64)
        if nodes.ndim != 2 or nodes.shape[1] != 2 or len(nodes) < least or not np.isfinite(nodes).all():
            raise ValueError(f"a ring of {len(ring)} points; at least {least} of two finite coordinates were expected")
        found.append(nodes)
    return found


def _declared(document: dict[str, Any]) -> int | None:
    """The EPSG code of the `crs` member; None without one. Raises ValueError for one that is no code."""
    member = document.get("crs")
    if member is None:
        return None
    name = str(member["properties"]["name"])
    if name.endswith("CRS84"):
        return _WGS84
    code = name.replace("::", ":").rsplit(":", 1)[-1]
    if "EPSG" not in name.upper() or not code.isdigit():
        raise ValueError(f"its reference system {name} is no EPSG code")
    return int(code)


def _converter(path: Path, epsg: int | None, every: Ring, place: Georeference) -> Any:
    """From the file's coordinates to local ones."""
    degrees = bool((np.abs(every[:, 0]) <= 180).all() and (np.abs(every[:, 1]) <= 90).all())
    if epsg is None and place.epsg is not None and degrees:
        epsg = _WGS84
    if epsg is not None and place.epsg is None:
        raise InputError(
            f"{path} is in EPSG:{epsg}, and the run has no place on the map",
            cause="the run was not georeferenced",
            hint="navigation or control points (swimm3r scale), or a file in the local coordinates of the maps",
        )
    origin = np.asarray(place.origin[:2])

    def to_local(ring: Ring) -> Ring:
        return (ring - origin) / place.grid_scale

    if epsg is None or epsg == place.epsg:
        return to_local
    pyproj = geo_package("pyproj")
    try:
        transform = pyproj.Transformer.from_crs(epsg, place.epsg, always_xy=True)
    except pyproj.exceptions.ProjError as error:
        raise damaged(path, f"there is no way from its EPSG:{epsg} to EPSG:{place.epsg} of the run", _REMEDY) from error

    def projected(ring: Ring) -> Ring:
        x, y = transform.transform(ring[:, 0], ring[:, 1])
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            raise damaged(path, f"coordinates outside of EPSG:{place.epsg}", _REMEDY)
        return to_local(np.stack([x, y], -1))

    return projected


def _area(ring: Ring) -> float:
    """Area of a ring of either sense."""
    x, y = (ring - ring[0]).T
    return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2)


def along(nodes: Ring, step: float) -> tuple[Float[np.ndarray, "m 2"], Float[np.ndarray, " m"]]:
    """Points along a line, evenly about a step apart, its ends included, and their distances from its begin."""
    lengths = np.linalg.norm(np.diff(nodes, axis=0), axis=1)
    total = np.concatenate([[0.0], np.cumsum(lengths)])
    at = np.linspace(0, total[-1], max(2, math.ceil(total[-1] / step) + 1))
    return np.stack([np.interp(at, total, nodes[:, k]) for k in range(2)], -1), at


def _distinct(names: Sequence[str]) -> list[str]:
    """Names that occur once; repeated ones get a number."""
    found: list[str] = []
    for name in names:
        taken, number = name, 2
        while taken in found:
            taken, number = f"{name} ({number})", number + 1
        found.append(taken)
    return found
