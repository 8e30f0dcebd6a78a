"""Maps as GeoTIFF: written tile by tile, then arranged for the cloud (COG, with overviews), whole or not at all."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from swimm3r.errors import InputError
from swimm3r.io.files.atomic import DRAFT, atomic_path
from swimm3r.io.files.damage import Remedy, damaged
from swimm3r.products.grid import Grid, Window
from swimm3r.products.packages import geo_package
from swimm3r.scene.georeference import Georeference

_BLOCK = 512  # cells along the side of a block of the file
_LOCAL = 'LOCAL_CS["Swimm3R local",UNIT["metre",1],AXIS["x",EAST],AXIS["y",NORTH]]'
_REMEDY = Remedy("swimm3r products RUN, which makes it again")


@dataclass(frozen=True)
class Band:
    """One band of a map."""

    name: str
    unit: str = ""


RGBA = (Band("red"), Band("green"), Band("blue"), Band("alpha"))


class MapFile:
    """A map that is filled window by window; `finish` arranges it, and `discard` drops what was written."""

    def __init__(self, path: Path, grid: Grid, place: Georeference, bands: Sequence[Band], dtype: str) -> None:
        rasterio = geo_package("rasterio")
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path, self._draft, self._bands = path, path.parent / f"{DRAFT}{os.getpid()}-{path.stem}.tif", tuple(bands)
        colored = tuple(bands) == RGBA
        self._file = rasterio.open(
            self._draft, "w", driver="GTiff", width=grid.columns, height=grid.rows, count=len(bands), dtype=dtype,
            crs=crs_of(place), transform=rasterio.Affine.from_gdal(*grid.affine(place)),
            nodata=None if colored else (np.nan if dtype.startswith("float") else 0),
            tiled=True, blockxsize=_BLOCK, blockysize=_BLOCK, compress="deflate", zlevel=1, sparse_ok=True,
            bigtiff="if_safer", photometric="rgb" if colored else "minisblack", **({"alpha": "yes"} if colored else {}),
        )  # fmt: skip
        self._lossy = "average" if dtype != "uint16" or colored else "nearest"

    def write(self, window: Window, values: np.ndarray) -> None:
        """Fill a window with [bands, h, w] or [h, w] values."""
        from rasterio.windows import Window as FileWindow

        where = FileWindow(window.column, window.row, window.columns, window.rows)  # pyright: ignore[reportCallIssue]
        self._file.write(values if values.ndim == 3 else values[None], window=where)

    def finish(self, **tags: str) -> Path:
        """Write the file in its place, with overviews, and return its path."""
        from rasterio.shutil import copy

        for number, band in enumerate(self._bands, 1):
            self._file.set_band_description(number, band.name)
            if band.unit:
                self._file.set_band_unit(number, band.unit)
        self._file.update_tags(**tags)
        self._file.close()
        with atomic_path(self.path) as draft:
            copy(
                self._draft, draft, driver="COG", compress="DEFLATE", level=6, predictor="YES", blocksize=_BLOCK,
                overview_resampling=self._lossy, bigtiff="IF_SAFER", sparse_ok="TRUE", num_threads="1",
            )  # fmt: skip
        self.discard()
        return self.path

    def discard(self) -> None:
        """Close and remove the draft."""
        self._file.close()
        for path in (self._draft, self._draft.with_name(f"{self._draft.name}.aux.xml")):
            path.unlink(missing_ok=True)


class StoredMap:
    """A map on disk, read window by window."""

    def __init__(self, path: Path) -> None:
        rasterio = geo_package("rasterio")
        try:
            self._file = rasterio.open(path)
        except rasterio.errors.RasterioIOError as error:
            raise damaged(path, str(error).splitlines()[0], _REMEDY) from error
        self.path = path

    def __enter__(self) -> "StoredMap":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self._file.height, self._file.width

    def read(self, window: Window | None = None, band: int | None = 1) -> np.ndarray:
        """One band of a window, or with None all of them; beyond the map the file's own "no data"."""
        if window is None:
            return self._file.read(band)
        from rasterio.windows import Window as FileWindow

        where = FileWindow(window.column, window.row, window.columns, window.rows)  # pyright: ignore[reportCallIssue]
        return self._file.read(band, window=where, boundless=True, fill_value=self._file.nodata or 0)

    def overview(self, long_side: int, band: int | None = None) -> np.ndarray:
        """The whole map with at most this many rows and columns, averaged by the file's overviews."""
        from rasterio.enums import Resampling

        shrink = min(1.0, long_side / max(self.shape))
        shape = tuple(max(1, round(n * shrink)) for n in self.shape)
        count = () if band is not None else (self._file.count,)
        return self._file.read(band, out_shape=(*count, *shape), resampling=Resampling.average)


def crs_of(place: Georeference) -> Any:
    """The reference system of maps: a projected one, local metres, or none where the unit is not known.

    Raises InputError where the georeference names a system that does not exist.
    """
    geo_package("rasterio")
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    if place.epsg is not None:
        try:
            return CRS.from_epsg(place.epsg)
        except CRSError as error:
            raise InputError(
                f"EPSG:{place.epsg}, the reference system of the run, does not exist",
                cause="a slip in the code that was given to swimm3r scale, or georeference.json was edited",
                hint="swimm3r scale RUN with the right code",
            ) from error
    return CRS.from_wkt(_LOCAL) if place.scale is not None else None


def as_rgba(colors: Float[np.ndarray, "h w 3"], shown: np.ndarray, levels: int = 255) -> np.ndarray:
    """Colors 0..1 as [4, h, w] integers of a map, transparent where nothing is shown."""
    dtype = np.uint8 if levels == 255 else np.uint16
    values = np.where(shown[..., None], np.nan_to_num(colors) * levels + 0.5, 0).astype(dtype)
    alpha = np.where(shown, levels, 0).astype(dtype)
    return np.concatenate([values, alpha[..., None]], -1).transpose(2, 0, 1)
