"""RUN/products/products.json: the products of a run, their grid and their figures."""

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from swimm3r.io.files.atomic import write_text
from swimm3r.io.files.damage import Remedy
from swimm3r.io.files.json_file import read_json
from swimm3r.rounding import rounded

FOLDER = "products"
RECORD = "products.json"
SCHEMA = 1
_REMEDY = Remedy("swimm3r products RUN, which writes it again")


@dataclass(frozen=True)
class HabitatRecord:
    """Habitat figures."""

    resolution: float  # distance of the heights they are computed from
    squares: int  # with figures of their own in habitat.csv
    planar_area: float  # of these squares
    surface_area: float
    rugosity: float | None  # None where there is no square
    mean_slope_deg: float | None


@dataclass(frozen=True)
class MapGrid:
    """The grid of maps in map coordinates, as records state it."""

    unit: str  # of lengths: m, or units of the run, the first of several, where its scale is not known
    gsd: float
    rows: int
    columns: int
    epsg: int | None
    west: float  # edges
    north: float


@dataclass(frozen=True)
class ProductsRecord(MapGrid):
    """The products of a run."""

    scale_std: float | None  # relative; None: not known
    sources: tuple[str, ...]  # of scale and place
    covered: float  # share of the cells with a height
    area: float  # of the cells with a height, unit^2
    lowest: float | None  # height in map coordinates
    highest: float | None
    height_std: float | None  # median over the cells, of one view
    views: float | None  # median over the cells
    place: str  # digest of the georeference that the maps were made with
    files: tuple[str, ...]
    notes: tuple[str, ...] = ()
    habitat: HabitatRecord | None = None
    schema: int = SCHEMA

    def save(self, folder: Path) -> None:
        """Write products.json, whole or not at all."""
        write_text(folder / RECORD, json.dumps(asdict(self), indent=2) + "\n")

    def __str__(self) -> str:
        u = self.unit
        size = f"{rounded(self.columns * self.gsd, 4)} x {rounded(self.rows * self.gsd, 4)} {u}"
        area_std = "" if self.scale_std is None else f" ± {rounded(2 * self.scale_std * self.area, 2)}"
        lines = [
            f"Map: {self.columns} x {self.rows} cells of {self.gsd:g} {u}, {size}, {self.covered:.0%} of it measured"
            f" ({rounded(self.area, 4)}{area_std} {u}²)"
        ]
        if self.lowest is not None and self.highest is not None:
            digits = max(0, -math.floor(math.log10(self.height_std or self.gsd)))
            lines.append(f"Heights: {self.lowest:.{digits}f} to {self.highest:.{digits}f} {u}{self._height_doubt()}")
        scale = "relative standard deviation not known" if self.scale_std is None else f"± {self.scale_std:.2%}"
        if u == "m":
            lines.append(f"Scale: {scale}, from {', '.join(self.sources) or 'the poses that were given'}")
        lines += self._habitat_lines()
        return "\n".join([*lines, *(f"Note: {note}" for note in self.notes)])

    def _height_doubt(self) -> str:
        if self.height_std is None:
            return ""
        return f" ± {rounded(self.height_std, 2)} {self.unit} (median of a cell, one view)"

    def _habitat_lines(self) -> list[str]:
        found = self.habitat
        if found is None or found.rugosity is None or found.mean_slope_deg is None:
            return []
        return [
            f"Surface: rugosity {found.rugosity:.3f}, mean slope {found.mean_slope_deg:.1f} degrees, from heights every"
            f" {found.resolution:.3g} {self.unit}; figures of {found.squares} squares in habitat.csv"
        ]


def summary_section(run: Path) -> dict[str, dict[str, Any]]:
    """The section "products" of the run's summary.json; none where RUN/products holds none."""
    record = read_record(run / FOLDER)
    if record is None:
        return {}
    figures = asdict(record)
    del figures["schema"], figures["place"]
    area_std = None if record.scale_std is None else 2 * record.scale_std * record.area
    return {"products": {**figures, "area_std": area_std}}


def read_record(folder: Path) -> ProductsRecord | None:
    """The record in RUN/products; None where there is none. Raises InputError where it is damaged."""
    path = folder / RECORD
    return read_json(path, ProductsRecord, _REMEDY) if path.is_file() else None
