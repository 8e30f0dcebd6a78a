"""The grid of a map: square cells, first row in the north, with an extent and a cell size chosen from the data.

Cell (row, column) has its north-west corner at (x0 + column gsd, y1 - row gsd), local. Its edges are multiples of the
cell size in map coordinates, so that maps of one place fit each other. Work goes by tiles, and memory with their size.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from swimm3r.errors import InputError, UsageError
from swimm3r.products.record import MapGrid
from swimm3r.products.survey import Survey
from swimm3r.scene.georeference import Georeference

_STEPS = (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10)  # of cell sizes chosen from the data, in every decade
_MOST_CELLS = 4e9  # of a grid: a COG of 12 GB
_COARSE = 24  # cells along a square that overview points are counted in
_LEAST_POINTS = 2  # overview points in a square; fewer are outliers


@dataclass(frozen=True)
class Window:
    """Cells of a grid: rows and columns from these on."""

    row: int
    column: int
    rows: int
    columns: int

    def widened(self, margin: int) -> "Window":
        """The window with a margin of cells on every side, also beyond the grid."""
        return Window(self.row - margin, self.column - margin, self.rows + 2 * margin, self.columns + 2 * margin)


@dataclass(frozen=True)
class Grid:
    """The cells of a map, in local coordinates."""

    x0: float  # west edge
    y1: float  # north edge
    gsd: float  # side of a cell
    rows: int
    columns: int

    def tiles(self, side: int) -> Iterator[Window]:
        """All cells in windows of at most this many rows and columns."""
        for row in range(0, self.rows, side):
            for column in range(0, self.columns, side):
                yield Window(row, column, min(side, self.rows - row), min(side, self.columns - column))

    def centers(self, window: Window) -> tuple[Float[np.ndarray, " columns"], Float[np.ndarray, " rows"]]:
        """x of the columns and y of the rows of a window, at the middle of the cells."""
        x = self.x0 + (window.column + np.arange(window.columns) + 0.5) * self.gsd
        y = self.y1 - (window.row + np.arange(window.rows) + 0.5) * self.gsd
        return x, y

    def cells(self, xy: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """(column, row) of points as fractions: 0.5 is the middle of the first cell."""
        return np.stack([(xy[..., 0] - self.x0) / self.gsd, (self.y1 - xy[..., 1]) / self.gsd], -1)

    def on_map(self, place: Georeference) -> MapGrid:
        """The grid in map coordinates."""
        west, step, _, north, _, _ = self.affine(place)
        return MapGrid(place.unit, step, self.rows, self.columns, place.epsg, west, north)

    def affine(self, place: Georeference) -> tuple[float, float, float, float, float, float]:
        """The transform from (column, row) to map coordinates, as GDAL orders it."""
        g = place.grid_scale
        return (place.origin[0] + g * self.x0, g * self.gsd, 0.0, place.origin[1] + g * self.y1, 0.0, -g * self.gsd)


def chosen_gsd(footprint: float) -> float:
    """The round cell size next above the size of an image's pixel on the ground."""
    decade = 10.0 ** math.floor(math.log10(footprint))
    return next(step * decade for step in _STEPS if step * decade >= footprint * (1 - 1e-9))


def grid_of(survey: Survey, gsd: float | None = None) -> Grid:
    """The grid that holds the surface of a survey; a cell is `gsd` wide, by default as large as an image's pixel.

    Raises InputError where nothing was measured, UsageError where the cells are too many.
    """
    footprint, g = survey.footprint, survey.place.grid_scale
    on_map = chosen_gsd(footprint) if gsd is None else gsd
    low, high = _extent(survey, max(_COARSE * footprint, on_map / g))
    origin = np.asarray(survey.place.origin[:2])
    first, last = np.floor((g * low + origin) / on_map), np.ceil((g * high + origin) / on_map)
    columns, rows = (last - first).astype(np.int64).tolist()
    if columns * rows > _MOST_CELLS:
        enough = chosen_gsd(on_map * math.sqrt(columns * rows / _MOST_CELLS) * 2)
        raise UsageError(
            f"a map with cells of {on_map:g} {survey.place.unit} would have {columns:,} x {rows:,} of them",
            cause="the cell size is far below what the extent of the survey is worth",
            hint=f"--gsd {enough:g}",
        )
    x0, y1 = (first[0] * on_map - origin[0]) / g, (last[1] * on_map - origin[1]) / g
    return Grid(float(x0), float(y1), on_map / g, rows, columns)


def _extent(survey: Survey, square: float) -> tuple[Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Corners of the squares that hold several points of the overview; single points are outliers."""
    points = np.concatenate([points[:, :2] for points in survey.overview.values()])
    at, which, counts = np.unique(
        np.floor(points / square).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    del at
    kept = points[counts[which.reshape(-1)] >= _LEAST_POINTS]
    if not len(kept):
        raise InputError(
            f"the depth maps of {survey.folder} hold too few points for a map",
            cause="almost no surface was confirmed by a second frame",
            hint="frames with more overlap, or more of them",
        )
    return kept.min(0), kept.max(0)
