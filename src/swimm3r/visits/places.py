"""Places that have changed: cells of one kind that hang together, with their figures, as polygons and as a table.

    volume = sum d gsd^2,    std = sum s gsd^2

as if all cells of a place shared one error: bends of the path and of the lens reach further than a place. Places of
height and of color are found apart and may overlap.
"""

import csv
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool
from scipy import ndimage

from swimm3r.io.files.atomic import write_text
from swimm3r.products.grid import Grid
from swimm3r.products.packages import geo_package
from swimm3r.scene.georeference import Georeference
from swimm3r.visits.change import COLOR_KINDS, HEIGHT_KINDS, Change, connected


@dataclass(frozen=True)
class Place:
    """One changed place; lengths in the unit of the map, heights positive where the ground has risen."""

    number: int
    kind: str  # gained, lost, paler or darker
    x: float  # middle in map coordinates
    y: float
    area: float
    height: float | None  # mean difference; None where no cell of a place of color has heights of both visits
    height_std: float | None  # typical, of a cell
    volume: float | None  # None for changes of color
    volume_std: float | None
    color: float | None  # mean CIELAB difference; None without clear colors
    lightness: float | None  # mean differences of L*, a*, b*
    red_green: float | None
    yellow_blue: float | None
    significance: float  # largest, in standard deviations


@dataclass(frozen=True)
class Outline:
    """The cells of a place inside a box of the grid."""

    row: int  # of the box
    column: int
    mask: Bool[np.ndarray, "h w"]


def find_places(change: Change, grid: Grid, place: Georeference) -> tuple[list[Place], list[Outline]]:
    """The places of a change, the largest first, and their cells."""
    masks: list[tuple[str, Any, np.ndarray]] = []
    for kinds, names in ((change.height_kind, HEIGHT_KINDS), (change.color_kind, COLOR_KINDS)):
        for code, name in names.items():
            labels, count = connected(kinds == code)
            boxes = ndimage.find_objects(labels)
            masks += [(name, boxes[k], labels[boxes[k]] == k + 1) for k in range(count)]
    masks.sort(key=lambda each: -int(each[2].sum()))
    found, outlines = [], []
    for number, (name, box, mask) in enumerate(masks, 1):
        rows, columns = np.nonzero(mask)
        at = rows + box[0].start, columns + box[1].start
        found.append(_figures(number, name, change, grid, place, at))
        outlines.append(Outline(box[0].start, box[1].start, mask))
    return found, outlines


def _figures(
    number: int, kind: str, change: Change, grid: Grid, place: Georeference, at: tuple[np.ndarray, np.ndarray]
) -> Place:
    by_height = kind in HEIGHT_KINDS.values()
    height, std = change.height.value[at].astype(np.float64), change.height.std[at].astype(np.float64)
    told = np.isfinite(height)
    cell = grid.gsd**2
    color = None if change.color is None else _mean(change.color.value[at])
    axes = [None] * 3 if change.lab is None else [_mean(change.lab[..., k][at]) for k in range(3)]
    of = change.height if by_height or change.color is None else change.color
    west, step, _, north, _, _ = grid.affine(place)
    return Place(
        number=number,
        kind=kind,
        x=west + step * (float(at[1].mean()) + 0.5),
        y=north - step * (float(at[0].mean()) + 0.5),
        area=len(height) * cell,
        height=_mean(height),
        height_std=float(np.median(std[told])) if told.any() else None,
        volume=float(height.sum()) * cell if by_height else None,
        volume_std=float(std.sum()) * cell if by_height else None,
        color=color,
        lightness=axes[0],
        red_green=axes[1],
        yellow_blue=axes[2],
        significance=float(np.nanmax(np.abs(of.significance[at]))),
    )


def write_table(path: Path, places: Sequence[Place]) -> None:
    """Write the places as CSV."""
    out = StringIO()
    table = csv.writer(out, lineterminator="\n")
    table.writerow([field.name for field in fields(Place)])
    for each in places:
        table.writerow(["" if v is None else f"{v:.10g}" if isinstance(v, float) else v for v in _row(each)])
    write_text(path, out.getvalue())


def write_polygons(
    path: Path, places: Sequence[Place], outlines: Sequence[Outline], grid: Grid, place: Georeference
) -> None:
    """Write the places as GeoJSON in map coordinates, whose system the `crs` member names, as QGIS does."""
    rasterio = geo_package("rasterio")
    from rasterio.features import shapes

    west, step, _, north, _, _ = grid.affine(place)
    parts = []
    for outline in outlines:
        corner = west + outline.column * step, north - outline.row * step
        transform = rasterio.Affine.from_gdal(corner[0], step, 0, corner[1], 0, -step)
        found = shapes(outline.mask.astype(np.uint8), mask=outline.mask, transform=transform)
        parts.append([shape["coordinates"] for shape, _ in found])
    features = [
        {
            "type": "Feature",
            "id": each.number,
            "properties": {name: value for name, value in asdict(each).items() if name != "number"},
            "geometry": {"type": "MultiPolygon", "coordinates": rings},
        }
        for each, rings in zip(places, parts, strict=True)
    ]
    document: dict[str, object] = {"type": "FeatureCollection", "features": features}
    if place.epsg is not None:
        document["crs"] = {"type": "name", "properties": {"name": f"urn:ogc:def:crs:EPSG::{place.epsg}"}}
    write_text(path, json.dumps(document, allow_nan=False) + "\n")


def _row(place: Place) -> list[object]:
    return [getattr(place, field.name) for field in fields(Place)]


def _mean(values: np.ndarray) -> float | None:
    return float(np.nanmean(values)) if np.isfinite(values).any() else None
