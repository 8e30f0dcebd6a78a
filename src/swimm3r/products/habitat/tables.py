"""Habitat figures of a map: for squares of the ground, for polygons, and profiles along lines; CSV and GeoTIFF.

Figures are computed from heights at a stated distance, means of the cells of elevation.tif: finer heights carry the
noise of depth maps, which rugosity takes for relief. Standard deviations are those that the scale and the heights
cause; a number whose deviation is not known has an empty field beside it.
"""

import csv
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from swimm3r.io.files.atomic import atomic_path
from swimm3r.products.geotiff import Band, MapFile, StoredMap
from swimm3r.products.grid import Grid, Window
from swimm3r.products.habitat.areas import Area, Line, along
from swimm3r.products.habitat.figures import LENGTHS, NAMES, Figures, figures
from swimm3r.products.packages import geo_package
from swimm3r.products.record import HabitatRecord
from swimm3r.products.settings import ProductSettings
from swimm3r.scene.georeference import Georeference

_CELL_M, _RESOLUTION_M = 1.0, 0.01  # of runs with scale, as coral reefs are surveyed
_CELLS = 256  # of the map, along a square of a run without scale
_COARSE = 5  # cells of the map between two heights, at least: the width of the windows that depth is matched by
_PIECE = 8_000_000  # cells of the map that are in memory at a time
_KNOWN = 0.5  # share of the cells of a mean


@dataclass(frozen=True)
class Lattice:
    """Heights at the middles of blocks of `block` x `block` cells of a map."""

    grid: Grid
    place: Georeference
    block: int
    folder: Path

    @property
    def spacing(self) -> float:
        """Distance of the heights, local."""
        return self.block * self.grid.gsd

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of whole blocks."""
        return self.grid.rows // self.block, self.grid.columns // self.block

    def heights(self, window: Window, name: str = "elevation") -> Float[np.ndarray, "h w"]:
        """Means over blocks, NaN where less than half of one is known."""
        step = max(1, _PIECE // max(1, window.columns * self.block**2))
        pieces = [np.zeros((0, window.columns))]
        with StoredMap(self.folder / f"{name}.tif") as stored:
            for row in range(0, window.rows, step):
                part = Window(window.row + row, window.column, min(step, window.rows - row), window.columns)
                pieces.append(self._means(stored, part))
        return np.concatenate(pieces)

    def _means(self, stored: StoredMap, window: Window) -> Float[np.ndarray, "h w"]:
        b = self.block
        values = stored.read(Window(window.row * b, window.column * b, window.rows * b, window.columns * b))
        values = values.astype(np.float64)
        blocks = values.reshape(window.rows, b, window.columns, b).transpose(0, 2, 1, 3).reshape(*_size(window), b * b)
        known = ~np.isnan(blocks)
        count = known.sum(-1)
        total = np.where(known, blocks, 0).sum(-1)
        return np.where(count >= _KNOWN * b * b, total / np.maximum(count, 1), np.nan)

    def place_of(self, row: float, column: float) -> tuple[float, float]:
        """Map coordinates of a height, by its row and column."""
        g = self.place.grid_scale
        x = self.grid.x0 + (column + 0.5) * self.spacing
        y = self.grid.y1 - (row + 0.5) * self.spacing
        return self.place.origin[0] + g * x, self.place.origin[1] + g * y


def lattice(folder: Path, grid: Grid, place: Georeference, settings: ProductSettings) -> Lattice:
    """The heights that habitat figures of the maps in a folder are computed from."""
    wanted = settings.habitat_resolution
    if wanted is None:
        wanted = max(_RESOLUTION_M if place.scale is not None else 0.0, _COARSE * grid.gsd)
    return Lattice(grid, place, max(1, round(wanted / grid.gsd)), folder)


def write_squares(heights: Lattice, settings: ProductSettings, files: list[str]) -> HabitatRecord:
    """habitat.csv and habitat.tif: figures of squares side by side. Returns those of all of them."""
    side = settings.habitat_cell or (_CELL_M if heights.place.scale is not None else _CELLS * heights.grid.gsd)
    m = max(2, round(side / heights.spacing))
    rows, columns = (max(1, math.ceil((n - 1) / m)) for n in heights.shape)
    half = heights.spacing / 2
    cells = Grid(heights.grid.x0 + half, heights.grid.y1 - half, m * heights.spacing, rows, columns)
    values = np.full((len(NAMES), rows, columns), np.nan, np.float32)
    table, every = [], []
    for row in range(rows):
        strip = heights.heights(Window(row * m, 0, m + 1, columns * m + 1))
        noise = heights.heights(Window(row * m, 0, m + 1, columns * m + 1), "elevation_std")
        for column in range(columns):
            own = np.s_[:, column * m : (column + 1) * m + 1]
            found = figures(strip[own], heights.spacing)
            if found is None:
                continue
            values[:, row, column] = [np.nan if value is None else value for value in asdict(found).values()]
            east, north = heights.place_of((row + 0.5) * m, (column + 0.5) * m)
            name = f"{row + 1}-{column + 1}"
            table.append(_row(name, (east, north), found, heights, _median(noise[own])))
            every.append(found)
    _write_table(heights.folder / "habitat.csv", _head(heights.place), table)
    unit = heights.place.unit
    bands = [Band(name, _unit(unit, LENGTHS.get(name, 0))) for name in NAMES]
    stored = MapFile(heights.folder / "habitat.tif", cells, heights.place, bands, "float32")
    try:
        stored.write(Window(0, 0, rows, columns), values)
        stored.finish()
    finally:
        stored.discard()
    files += ["habitat.csv", "habitat.tif"]
    return _of_all(every, heights.spacing)


def write_areas(heights: Lattice, areas: Sequence[Area], files: list[str]) -> list[str]:
    """areas.csv: figures of polygons. Returns the names of those that lie outside of what was measured."""
    table, outside = [], []
    for area in areas:
        window, own = squares_inside(heights, area)
        found = None
        if window.rows > 1 and window.columns > 1:
            found = figures(heights.heights(window), heights.spacing, own)
        if found is None:
            outside.append(area.name)
            continue
        found = _of_exact_area(found, area.exact_area, whole=lies_on_map(heights, area))
        noise = heights.heights(window, "elevation_std")
        middle = np.mean(area.bounds, axis=0) * heights.place.grid_scale + heights.place.origin[:2]
        table.append(_row(area.name, (float(middle[0]), float(middle[1])), found, heights, _median(noise)))
    _write_table(heights.folder / "areas.csv", _head(heights.place), table)
    files.append("areas.csv")
    return outside


def write_profiles(heights: Lattice, lines: Sequence[Line], files: list[str]) -> list[str]:
    """profiles.csv, the heights along lines, and lines.csv, a figure each. Returns the names of lines without any."""
    u, place = heights.place.unit, heights.place
    profiles, table, outside = [], [], []
    for line in lines:
        points, distance = along(line.nodes, heights.spacing)
        z = sampled(heights, points)
        std = sampled(heights, points, "elevation_std")
        on_map = points * place.grid_scale + place.origin[:2]
        for at, (east, north), height, noise in zip(distance, on_map, z, std, strict=True):
            profiles.append(
                [line.name, *(f"{value:.6g}" for value in (at,)), *_place(east, north), _f(height), _f(noise)]
            )
        known = ~np.isnan(z)
        steps = known[1:] & known[:-1]
        straight = np.diff(distance)[steps]
        s, length = place.scale_std, float(straight.sum())
        if not length:  # outside, or both ends are one point
            outside.append(line.name)
            continue
        over = float(np.hypot(straight, np.diff(z)[steps]).sum())
        relief = float(np.ptp(z[known]))
        deviation = relief_std(relief, place, _median(std))
        table.append([
            line.name, _f(steps.mean()), _f(length), _f(None if s is None else s * length), _f(over),
            _f(None if s is None else s * over), _f(over / length), _f(relief), _f(deviation),
            _f(heights.spacing),
        ])  # fmt: skip
    head = ["name", f"distance_{u}", "easting", "northing", f"height_{u}", f"height_std_{u}"]
    _write_table(heights.folder / "profiles.csv", head, profiles)
    head = [
        "name", "coverage", f"length_{u}", f"length_std_{u}", f"surface_length_{u}", f"surface_length_std_{u}",
        "chain_rugosity", f"relief_{u}", f"relief_std_{u}", f"resolution_{u}",
    ]  # fmt: skip
    _write_table(heights.folder / "lines.csv", head, table)
    files += ["profiles.csv", "lines.csv"]
    return outside


def sampled(heights: Lattice, points: Float[np.ndarray, "n 2"], name: str = "elevation") -> Float[np.ndarray, " n"]:
    """Heights at local points, bilinear between those of the lattice; NaN beside holes and off the map."""
    at = heights.grid.cells(points) / heights.block - 0.5
    found = np.full(len(at), np.nan)
    for start in range(0, len(at), 1024):  # a long line is read piece by piece
        piece = at[start : start + 1024]
        low = np.floor(piece.min(0)).astype(int)
        high = np.floor(piece.max(0)).astype(int) + 2
        window = Window(int(low[1]), int(low[0]), int(high[1] - low[1]), int(high[0] - low[0]))
        if not _on_map(heights, window):
            continue
        values = heights.heights(window, name)
        column, row = (np.floor(piece[:, k]).astype(int) - low[k] for k in range(2))
        u, v = (piece[:, k] - np.floor(piece[:, k]) for k in range(2))
        upper = values[row, column] * (1 - u) + values[row, column + 1] * u
        lower = values[row + 1, column] * (1 - u) + values[row + 1, column + 1] * u
        found[start : start + 1024] = upper * (1 - v) + lower * v
    return found


def _of_all(squares: Sequence[Figures], resolution: float) -> HabitatRecord:
    planar, surface = (sum(getattr(one, name) for one in squares) for name in ("planar_area", "surface_area"))
    slopes = sum(one.mean_slope_deg * one.planar_area for one in squares)
    known = planar > 0
    return HabitatRecord(
        resolution,
        len(squares),
        planar,
        surface,
        surface / planar if known else None,
        slopes / planar if known else None,
    )


def _on_map(heights: Lattice, window: Window) -> bool:
    rows, columns = heights.shape
    last_row, last_column = window.row + window.rows, window.column + window.columns
    return window.row < rows and window.column < columns and last_row > 0 and last_column > 0


def squares_inside(heights: Lattice, area: Area) -> tuple[Window, Bool[np.ndarray, "h w"]]:
    """The heights around a polygon, and the squares between them whose middle lies inside."""
    geo_package("rasterio")
    from rasterio import Affine
    from rasterio.features import rasterize

    window = _clipped(_around(heights, area), *heights.shape)
    if window.rows < 2 or window.columns < 2:
        return window, np.zeros((0, 0), bool)
    d = heights.spacing
    x, y = heights.grid.x0 + (window.column + 0.5) * d, heights.grid.y1 - (window.row + 0.5) * d
    shapes = [
        {"type": "Polygon", "coordinates": [[*ring.tolist(), ring[0].tolist()] for ring in part]} for part in area.parts
    ]
    burned = rasterize(
        shapes, out_shape=(window.rows - 1, window.columns - 1), transform=Affine(d, 0, x, 0, -d, y), dtype="uint8"
    )
    return window, np.asarray(burned, bool)


def lies_on_map(heights: Lattice, area: Area) -> bool:
    """Return whether all of a polygon does: squares beyond the map are in no window of it."""
    around = _around(heights, area)
    return _clipped(around, *heights.shape) == around


def _around(heights: Lattice, area: Area) -> Window:
    """The heights around a polygon, also those beyond the map."""
    low, high = area.bounds
    west, north = np.floor(heights.grid.cells(np.array([low[0], high[1]])) / heights.block - 0.5).astype(int).tolist()
    east, south = np.ceil(heights.grid.cells(np.array([high[0], low[1]])) / heights.block - 0.5).astype(int).tolist()
    return Window(north, west, south - north + 1, east - west + 1)


def _clipped(window: Window, rows: int, columns: int) -> Window:
    """The part of a window that lies on a map of this size."""
    row, column = max(window.row, 0), max(window.column, 0)
    last_row, last_column = min(window.row + window.rows, rows), min(window.column + window.columns, columns)
    return Window(row, column, max(0, last_row - row), max(0, last_column - column))


def _of_exact_area(found: Figures, exact: float, *, whole: bool) -> Figures:
    """Figures with the area of the polygon itself for that of its squares; `whole`: all of it is on the map."""
    planar = exact * found.coverage if whole else found.planar_area
    return replace(found, planar_area=planar, surface_area=planar * found.rugosity, coverage=min(1.0, planar / exact))


def _head(place: Georeference) -> list[str]:
    u, head = place.unit, ["name", "easting", "northing"]
    for name in NAMES:
        power = LENGTHS.get(name, 0)
        head.append(f"{name}_{_suffix(u, power)}" if power else name)
        if name in ("planar_area", "surface_area", "relief"):
            head.append(f"{name}_std_{_suffix(u, power)}")
    return [*head, f"resolution_{u}"]


def _row(name: str, at: tuple[float, float], found: Figures, heights: Lattice, noise: float | None) -> list[str]:
    s = heights.place.scale_std
    stds = {
        "planar_area": None if s is None else 2 * s * found.planar_area,
        "surface_area": None if s is None else 2 * s * found.surface_area,
        "relief": relief_std(found.relief, heights.place, noise),
    }
    row = [name, *_place(*at)]
    for figure, value in asdict(found).items():
        row.append(_f(value))
        row += [_f(stds[figure])] if figure in stds else []
    return [*row, _f(heights.spacing)]


def relief_std(relief: float, place: Georeference, noise: float | None) -> float | None:
    """The standard deviation of a difference of two heights, by the scale and by the noise of both.

    None where either is not known.
    """
    if noise is None or (place.scale is not None and place.scale_std is None):
        return None
    return math.hypot((place.scale_std or 0.0) * relief, math.sqrt(2) * noise)


def _median(values: np.ndarray) -> float | None:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else None


def _size(window: Window) -> tuple[int, int]:
    return window.rows, window.columns


def _suffix(unit: str, power: int) -> str:
    return unit if power == 1 else f"{unit}{power}"


def _unit(unit: str, power: int) -> str:
    return "" if power == 0 else _suffix(unit, power)


def _place(east: float, north: float) -> Iterator[str]:
    yield from (f"{value:.4f}" for value in (east, north))


def _f(value: float | None) -> str:
    return "" if value is None or np.isnan(value) else f"{value:.6g}"


def _write_table(path: Path, head: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    with atomic_path(path) as draft, draft.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(head)
        writer.writerows(rows)
