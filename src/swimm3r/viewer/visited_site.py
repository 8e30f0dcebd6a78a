"""A site that was visited several times, as the viewer shows it: the ground at each visit, and the cells that changed.

Grounds are read from the maps of `swimm3r visits`, with rows and columns left out where a browser could not hold all.
Coordinates are map coordinates less the middle of the map, z up.
"""

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from swimm3r.errors import InputError
from swimm3r.io.files.damage import Remedy, guard
from swimm3r.products.geotiff import StoredMap
from swimm3r.products.packages import require_packages
from swimm3r.rounding import rounded
from swimm3r.visits.change import COLOR_KINDS, HEIGHT_KINDS
from swimm3r.visits.page import COLORS
from swimm3r.visits.record import RECORD, VisitsRecord, change_lines, read_record

_REMEDY = Remedy("swimm3r visits RUN_A RUN_B --out DIR, which writes it again")
_MOST_CELLS = 250_000  # of a ground
_ABOVE = 0.5  # cells by which changes lie above the ground of both visits
_LABELED = 12  # of the largest places


@dataclass(frozen=True)
class Cells:
    """Colored cells of a map."""

    xyz: Float32[np.ndarray, "n 3"]
    rgb: UInt8[np.ndarray, "n 3"]


@dataclass(frozen=True)
class ShownChange:
    """The change from one visit to the next."""

    title: str
    lines: tuple[str, ...]
    cells: Cells  # those that have changed, above the ground of both visits
    labels: tuple[tuple[tuple[float, float, float], str], ...]  # of the largest places


@dataclass(frozen=True)
class VisitedSite:
    """Grounds and changes in the order of the visits."""

    record: VisitsRecord
    cell: float  # side of a shown cell
    grounds: tuple[Cells, ...]
    changes: tuple[ShownChange, ...]

    @property
    def middle(self) -> tuple[float, float, float]:
        """Middle of the ground at the last visit."""
        x, y, z = np.median(self.grounds[-1].xyz, axis=0).tolist()
        return x, y, z

    @property
    def size(self) -> float:
        """Larger side of the site."""
        low, high = zip(
            *((cells.xyz.min(0), cells.xyz.max(0)) for cells in self.grounds if len(cells.xyz)), strict=True
        )
        return float((np.max(high, axis=0) - np.min(low, axis=0))[:2].max())


def is_visited_site(folder: Path) -> bool:
    """Return whether a folder was written by `swimm3r visits`."""
    return (folder / RECORD).is_file()


def open_visited_site(folder: Path) -> VisitedSite:
    """Read the maps of visits.

    Raises InputError where one is missing or damaged, DeviceError without the packages of `swimm3r[geo]`.
    """
    require_packages()
    record = read_record(folder)
    step = max(1, math.ceil(math.sqrt(record.rows * record.columns / _MOST_CELLS)))
    heights = [_read(folder / f"elevation_{k + 1}.tif", step)[0] for k in range(len(record.visits))]
    known = [np.isfinite(height) for height in heights]
    if not all(each.any() for each in known):
        raise InputError(
            f"an elevation map of {folder} shows no ground",
            cause="the visit saw none, or the file was replaced",
            hint=_REMEDY.hint,
        )
    level = float(np.median(heights[0][known[0]]))
    grounds = []
    for k, height in enumerate(heights):
        photo = _read(folder / f"orthophoto_{k + 1}.tif", step)
        seen = known[k] & (photo[3] > 0)
        grounds.append(Cells(_places(record, step, height - level, seen), photo[:3].transpose(1, 2, 0)[seen]))
    changes = tuple(
        _change(folder, record, k, np.fmax(heights[k], heights[k + 1]) - level, step)
        for k in range(len(record.changes))
    )
    return VisitedSite(record, step * record.gsd, tuple(grounds), changes)


def _change(folder: Path, record: VisitsRecord, k: int, height: Float32[np.ndarray, "h w"], step: int) -> ShownChange:
    change = record.changes[k]
    rgb = np.zeros((*height.shape, 3), np.uint8)
    layers = (("color_changed", COLOR_KINDS), ("height_changed", HEIGHT_KINDS))  # heights above colors
    for name, kinds in layers:
        if f"{name}.tif" in change.files:
            codes = _read(folder / change.folder / f"{name}.tif", step)[0]
            for code, kind in kinds.items():
                rgb[codes == code] = COLORS[kind]
    changed = rgb.any(-1) & np.isfinite(height)
    xyz = _places(record, step, height + _ABOVE * step * record.gsd, changed)
    lines = tuple(line.strip() for line in change_lines(change, record.unit, record.threshold))
    title = f"{change.earlier} to {change.later}"
    labels = _labels(folder / change.folder / "places.csv", record, height, step)
    return ShownChange(title, lines, Cells(xyz, rgb[changed]), labels)


def _labels(
    path: Path, record: VisitsRecord, height: Float32[np.ndarray, "h w"], step: int
) -> tuple[tuple[tuple[float, float, float], str], ...]:
    """Places and words of the largest places."""
    with guard(path, _REMEDY), path.open(encoding="utf-8", newline="") as table:
        rows = list(csv.DictReader(table))[:_LABELED]
    found = []
    for row in rows:
        x, y = float(row["x"]) - record.west, record.north - float(row["y"])
        j, i = (min(int(at / (record.gsd * step)), n - 1) for at, n in ((x, height.shape[1]), (y, height.shape[0])))
        near = height[max(0, i - 5) : i + 6, max(0, j - 5) : j + 6]
        z = float(np.nanmedian(near)) if np.isfinite(near).any() else 0.0
        middle = record.columns * record.gsd / 2, record.rows * record.gsd / 2
        volume, lightness = row["volume"], row["lightness"]
        told = f"{rounded(float(volume), 2, sign=True)} {record.unit}³" if volume else f"L* {float(lightness):+.0f}"
        found.append(((x - middle[0], middle[1] - y, z), f"{row['number']} {row['kind']} {told}"))
    return tuple(found)


def _places(
    record: VisitsRecord, step: int, height: Float32[np.ndarray, "h w"], chosen: Bool[np.ndarray, "h w"]
) -> Float32[np.ndarray, "n 3"]:
    """Coordinates of chosen cells."""
    row, column = np.nonzero(chosen)
    x = (column * step + 0.5) * record.gsd - record.columns * record.gsd / 2
    y = record.rows * record.gsd / 2 - (row * step + 0.5) * record.gsd
    return np.column_stack([x, y, height[chosen]]).astype(np.float32)


def _read(path: Path, step: int) -> np.ndarray:
    """All bands of a map at every `step`-th row and column."""
    with StoredMap(path) as stored:
        return stored.read(band=None)[:, ::step, ::step]
