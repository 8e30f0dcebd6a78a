"""Files of visits: maps of each one, and layers, polygons and table of each change, on the common grid."""

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from swimm3r.products.elevation import frames_over
from swimm3r.products.frame_colors import Points, blended
from swimm3r.products.geotiff import RGBA, Band, MapFile, as_rgba
from swimm3r.products.grid import Grid
from swimm3r.products.survey import Colors, Survey
from swimm3r.progress import Progress
from swimm3r.scene.georeference import Georeference
from swimm3r.visits import color
from swimm3r.visits.change import LESS, MORE, Change
from swimm3r.visits.ground import Ground
from swimm3r.visits.places import Place, find_places, write_polygons, write_table
from swimm3r.visits.record import ChangeRecord

_TILE = 512  # cells along the side of the windows that orthophotos are made in


def write_change(
    names: tuple[str, str], change: Change, grid: Grid, place: Georeference, folder: Path
) -> tuple[ChangeRecord, list[Place]]:
    """Write the layers, polygons and table of one change into a folder; `names` are those of the two visits."""
    places, outlines = find_places(change, grid, place)
    layers: dict[str, tuple[Band, np.ndarray]] = {
        "height_change": (Band("change of height", place.unit), change.height.value),
        "height_change_std": (Band("standard deviation", place.unit), change.height.std),
        "height_significance": (Band("standard deviations"), change.height.significance),
        "height_changed": (Band("1 unchanged, 2 gained, 3 lost"), change.height_kind),
    }
    if change.color is not None:
        layers["color_change"] = (Band("CIELAB difference"), change.color.value)
        layers["color_changed"] = (Band("1 unchanged, 2 paler, 3 darker"), change.color_kind)
        layers["color_significance"] = (Band("standard deviations"), change.color.significance)
    for name, (band, values) in layers.items():
        _write_layer(folder / f"{name}.tif", grid, place, (band,), values)
    write_polygons(folder / "places.geojson", places, outlines, grid, place)
    write_table(folder / "places.csv", places)
    files = (*(f"{name}.tif" for name in layers), "places.geojson", "places.csv")
    return _record(names, change, places, grid.gsd**2, folder.name, files), places


def write_maps(
    survey: Survey,
    ground: Ground,
    factors: Float[np.ndarray, "3"],
    grid: Grid,
    paths: tuple[Path, Path],
    progress: Progress,
) -> UInt8[np.ndarray, "4 h w"]:
    """Write elevation and orthophoto of a visit to two paths, and return the orthophoto.

    It is without the water and in the light of the first visit, into which `factors` bring linear colors; of a run
    without water as filmed.
    """  # fmt: skip
    place = survey.place
    height = (ground.height + place.origin[2]).astype(np.float32)
    _write_layer(paths[0], grid, place, (Band("height", place.unit),), height)
    kind: Colors = "physical" if survey.has("physical") else "filmed"
    rgba = np.zeros((4, grid.rows, grid.columns), np.uint8)
    tiles = list(grid.tiles(_TILE))
    for done, window in enumerate(tiles):
        progress(f"orthophoto of {survey.folder.name}", done, len(tiles))
        own = np.s_[window.row : window.row + window.rows, window.column : window.column + window.columns]
        frames, known = frames_over(survey, grid, window), ~np.isnan(ground.height[own])
        rows, columns = np.nonzero(known)
        if not frames or not len(rows):
            continue
        x, y = grid.centers(window)
        xyz = np.stack([x[columns], y[rows], ground.height[own][rows, columns].astype(np.float64)], -1)
        found = blended(survey, Points(xyz, size=grid.gsd), frames, [kind])[kind]
        if kind == "physical":
            found = np.where(np.isnan(found), np.nan, color.shown(color.linear(found) * factors))
        image = np.full((*known.shape, 3), np.nan, np.float32)
        image[rows, columns] = found
        rgba[:, own[0], own[1]] = as_rgba(image, np.logical_not(np.isnan(image).any(-1)))
    progress(f"orthophoto of {survey.folder.name}", len(tiles), len(tiles))
    _write_layer(paths[1], grid, place, RGBA, rgba)
    return rgba


def _write_layer(path: Path, grid: Grid, place: Georeference, bands: Sequence[Band], values: np.ndarray) -> None:
    """Write [h, w] or [bands, h, w] values as a map."""
    map_file = MapFile(path, grid, place, bands, str(values.dtype))
    try:
        for window in grid.tiles(_TILE):
            own = np.s_[window.row : window.row + window.rows, window.column : window.column + window.columns]
            map_file.write(window, values[(..., *own)])
        map_file.finish(TIFFTAG_SOFTWARE=f"Swimm3R {version('swimm3r')}")
    finally:
        map_file.discard()


def _record(
    names: tuple[str, str], change: Change, places: list[Place], cell: float, folder: str, files: tuple[str, ...]
) -> ChangeRecord:
    area = [
        float((kind == code).sum()) * cell for kind in (change.height_kind, change.color_kind) for code in (MORE, LESS)
    ]
    gained, lost = (_volume(places, kind) for kind in ("gained", "lost"))
    red, green, blue = (float(gain) for gain in change.gains)
    return ChangeRecord(
        earlier=names[0],
        later=names[1],
        folder=folder,
        compared_area=float(change.comparable.sum()) * cell,
        gained_area=area[0],
        lost_area=area[1],
        paler_area=area[2],
        darker_area=area[3],
        gained_volume=gained[0],
        gained_volume_std=gained[1],
        lost_volume=lost[0],
        lost_volume_std=lost[1],
        height_std=_typical(change.height.std),
        height_inflation=change.height.inflation,
        shifted=change.shifted,
        color_std=None if change.color is None else _typical(change.color.std),
        color_inflation=None if change.color is None else change.color.inflation,
        gains=(red, green, blue),
        places=len(places),
        files=files,
    )


def _volume(places: list[Place], kind: str) -> tuple[float, float]:
    """Volume of the places of a kind, and its standard deviation."""
    found = [(each.volume or 0.0, each.volume_std or 0.0) for each in places if each.kind == kind]
    return sum(volume for volume, _ in found), float(np.sqrt(sum(std**2 for _, std in found)))


def _typical(std: np.ndarray) -> float | None:
    return float(np.nanmedian(std)) if np.isfinite(std).any() else None
