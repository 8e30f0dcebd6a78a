"""All map products of a run, in one pass over the tiles of its grid, then what is made of the finished maps."""

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

import numpy as np

from swimm3r.errors import InputError, UsageError
from swimm3r.io.files.atomic import write_text
from swimm3r.io.files.cache_key import cache_key
from swimm3r.io.files.folder_lock import folder_lock
from swimm3r.io.files.outputs import output_folder
from swimm3r.products.elevation import elevation, frames_over, hill_shade
from swimm3r.products.frame_colors import Points, blended
from swimm3r.products.geotiff import RGBA, Band, MapFile, as_rgba
from swimm3r.products.grid import Grid, Window, grid_of
from swimm3r.products.habitat.areas import Area, Line, read_areas
from swimm3r.products.habitat.tables import Lattice, lattice, write_areas, write_profiles, write_squares
from swimm3r.products.packages import require_packages
from swimm3r.products.preview import write_previews
from swimm3r.products.record import FOLDER, RECORD, HabitatRecord, ProductsRecord, read_record, summary_section
from swimm3r.products.settings import ProductSettings
from swimm3r.products.solids.write import write_solids
from swimm3r.products.survey import Colors, Survey, open_survey
from swimm3r.progress import Progress, watched

ORTHOPHOTOS: dict[Colors, str] = {
    "restored": "orthophoto.tif",
    "filmed": "orthophoto_filmed.tif",
    "physical": "orthophoto_physical.tif",
}
_NO_WATER = "no orthophoto without water: the run has no restored frames"


def write_products(
    run: Path, out: Path | None, settings: ProductSettings, progress: Progress | None = None
) -> ProductsRecord:
    """Write the products of a run into `out`, by default RUN/products; see `swimm3r.products.write_products`."""
    require_packages()
    survey = open_survey(run)
    shapes = None if settings.areas is None else read_areas(settings.areas, survey.place)  # before the work
    grid = grid_of(survey, settings.gsd)
    with output_folder(out or run / FOLDER) as folder, watched(progress) as told:
        before = _made_before(folder)
        totals = _write_maps(survey, grid, folder, settings, told)
        heights = lattice(folder, grid, survey.place, settings)
        notes, habitat = _write_habitat(heights, settings, shapes, totals.files)
        notes += write_solids(survey, grid.gsd, folder, settings, totals.files, told)
        left = [name for name in before if name not in totals.files and (folder / name).is_file()]
        notes += [f"of an earlier swimm3r products, and not made again: {', '.join(left)}"] if left else []
        record = _record(survey, grid, totals, notes, habitat)
        write_previews(folder, record.unit, totals.files)
        record.save(folder)
    if out is None:
        _add_to_summary(run)
    return record


def _made_before(folder: Path) -> tuple[str, ...]:
    """The files that the record in a folder lists; none where there is no record that can be read."""
    with suppress(InputError):
        record = read_record(folder)
        return () if record is None else record.files
    return ()


def _add_to_summary(run: Path) -> None:
    """Bring the section "products" of summary.json up to date."""
    with suppress(UsageError), folder_lock(run):  # a run in progress adds it when it writes next
        path = run / "summary.json"
        summary = json.loads(path.read_text(encoding="utf-8"))
        write_text(path, json.dumps(summary | summary_section(run), indent=2) + "\n")


@dataclass
class _Totals:
    """Figures of the cells, gathered tile by tile."""

    files: list[str] = field(default_factory=list)
    cells: int = 0
    lowest: float = np.inf
    highest: float = -np.inf
    std: list[np.ndarray] = field(default_factory=list)  # a sample of each tile
    views: list[np.ndarray] = field(default_factory=list)

    def add(self, height: np.ndarray, std: np.ndarray, views: np.ndarray) -> None:
        known = ~np.isnan(height)
        if not known.any():
            return
        self.cells += int(known.sum())
        self.lowest, self.highest = min(self.lowest, height[known].min()), max(self.highest, height[known].max())
        self.std.append(std[::7, ::7][~np.isnan(std[::7, ::7])])
        self.views.append(views[::7, ::7][views[::7, ::7] > 0])


def _write_maps(survey: Survey, grid: Grid, folder: Path, settings: ProductSettings, progress: Progress) -> _Totals:
    """Elevation with what it rests on, hill-shade and orthophotos."""
    unit, totals = survey.place.unit, _Totals()
    kinds: list[Colors] = [kind for kind in ORTHOPHOTOS if survey.has(kind)]
    with _maps(survey, grid, folder, kinds, unit) as maps:
        tiles = list(grid.tiles(settings.tile))
        for done, window in enumerate(tiles):
            progress("making maps", done, len(tiles))
            _write_tile(survey, grid, window, maps, kinds, totals, settings.min_views)
        progress("making maps", len(tiles), len(tiles))
        if not totals.cells:
            raise InputError(
                "no cell of the map has a height",
                cause=f"cells of {grid.gsd:g} {unit} are larger than the measured ground, or none is shown by"
                f" {settings.min_views} depth maps",
                hint="without --gsd and --min-views",
            )
        (folder / RECORD).unlink(missing_ok=True)  # of maps that are replaced from here on, one by one
        about = {"TIFFTAG_SOFTWARE": f"Swimm3R {version('swimm3r')}"}
        totals.files += [map.finish(**about).name for map in maps.values()]
    return totals


@contextmanager
def _maps(survey: Survey, grid: Grid, folder: Path, kinds: list[Colors], unit: str) -> Iterator[dict[str, MapFile]]:
    """The map files by their names, open for writing; what was not finished is discarded."""
    wanted: dict[str, tuple[tuple[Band, ...], str]] = {
        "elevation": ((Band("height", unit),), "float32"),
        "elevation_std": ((Band("standard deviation of one view", unit),), "float32"),
        "confidence": ((Band("confidence"),), "float32"),
        "views": ((Band("number of views"),), "uint16"),
        "hillshade": ((Band("hill-shade"),), "uint8"),
    }
    for kind in kinds:
        wanted[Path(ORTHOPHOTOS[kind]).stem] = (RGBA, "uint16" if kind == "physical" else "uint8")
    with ExitStack() as stack:
        maps = {}
        for name, (bands, dtype) in wanted.items():
            maps[name] = MapFile(folder / f"{name}.tif", grid, survey.place, bands, dtype)
            stack.callback(maps[name].discard)
        yield maps


def _write_tile(
    survey: Survey,
    grid: Grid,
    window: Window,
    maps: dict[str, MapFile],
    kinds: list[Colors],
    totals: _Totals,
    min_views: int,
) -> None:
    wide = window.widened(1)  # slopes at the border need a neighbor
    frames = frames_over(survey, grid, wide)
    if not frames:
        return
    found = elevation(survey, grid, wide, frames, min_views)
    own = np.s_[1:-1, 1:-1]
    height, std, views = found.height[own], found.std[own], found.views[own]
    on_map = height + survey.place.origin[2]
    maps["elevation"].write(window, on_map.astype(np.float32))
    maps["elevation_std"].write(window, std)
    maps["confidence"].write(window, np.where(np.isnan(height), np.nan, found.confidence[own]).astype(np.float32))
    maps["views"].write(window, views)
    maps["hillshade"].write(window, hill_shade(found.height, grid.gsd)[own])
    totals.add(on_map, std, views)
    rows, columns = np.nonzero(~np.isnan(height))
    x, y = grid.centers(window)
    points = Points(np.stack([x[columns], y[rows], height[rows, columns]], -1), size=grid.gsd)
    for kind, colors in blended(survey, points, frames, kinds).items():
        image = np.full((*height.shape, 3), np.nan, np.float32)
        image[rows, columns] = colors
        levels = 65535 if kind == "physical" else 255
        rgba = as_rgba(image, np.logical_not(np.isnan(image).any(-1)), levels)
        maps[Path(ORTHOPHOTOS[kind]).stem].write(window, rgba)


def _write_habitat(
    heights: Lattice,
    settings: ProductSettings,
    shapes: tuple[tuple[Area, ...], tuple[Line, ...]] | None,
    files: list[str],
) -> tuple[list[str], HabitatRecord]:
    """Tables of habitat figures; notes about what has none, and the figures of the whole map."""
    squares, outside = write_squares(heights, settings, files), []
    if shapes is not None:
        areas, lines = shapes
        outside = [*write_areas(heights, areas, files), *write_profiles(heights, lines, files)]
    notes = [f"no surface was measured in {', '.join(outside)} of {settings.areas}"] if outside else []
    return notes, squares


def _record(survey: Survey, grid: Grid, totals: _Totals, notes: list[str], habitat: HabitatRecord) -> ProductsRecord:
    place = survey.place
    std, views = (np.concatenate(parts) if parts else np.zeros(0) for parts in (totals.std, totals.views))
    return ProductsRecord(
        **vars(grid.on_map(place)),
        scale_std=place.scale_std,
        sources=place.sources,
        covered=totals.cells / (grid.rows * grid.columns),
        area=totals.cells * grid.gsd**2,
        lowest=float(totals.lowest) if totals.cells else None,
        highest=float(totals.highest) if totals.cells else None,
        height_std=float(np.median(std)) if len(std) else None,
        views=float(np.median(views)) if len(views) else None,
        place=cache_key(place),
        files=tuple(totals.files),
        notes=(*notes, *(() if survey.has("restored") else (_NO_WATER,))),
        habitat=habitat,
    )
