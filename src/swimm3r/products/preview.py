"""Small images of the maps, for the report and for a first look: PNG, with a color bar where colors are numbers."""

import math
from collections.abc import Collection
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from swimm3r.io import images
from swimm3r.products.geotiff import StoredMap

PREVIEWS = {  # file -> caption
    "preview_orthophoto.png": "Orthophoto without water",
    "preview_orthophoto_filmed.png": "Orthophoto as filmed",
    "preview_elevation.png": "Elevation, colored by height and shaded",
    "preview_views.png": "Number of depth maps that show a cell",
}
_LONG_SIDE = 1200
_PAPER = 255  # gray level of holes
_BAR = 0.02  # width of the color bar by the long side of the image
_MARKS = 5


def write_previews(folder: Path, unit: str, made: Collection[str]) -> None:
    """Write the previews of the maps in a folder that were `made` now, and drop those of others."""
    for name in ("orthophoto", "orthophoto_filmed"):
        (folder / f"preview_{name}.png").unlink(missing_ok=True)
        if f"{name}.tif" in made:
            with StoredMap(folder / f"{name}.tif") as stored:
                rgba = stored.overview(_LONG_SIDE)
            _write(folder, name, _on_paper(rgba[:3].transpose(1, 2, 0), rgba[3] > 127))
    with StoredMap(folder / "elevation.tif") as stored:
        height = stored.overview(_LONG_SIDE, 1)
    with StoredMap(folder / "hillshade.tif") as stored:
        shade = stored.overview(_LONG_SIDE, 1)
    with StoredMap(folder / "views.tif") as stored:
        views = stored.overview(_LONG_SIDE, 1).astype(np.float64)
    _write(folder, "elevation", relief(height.astype(np.float64), shade, unit))
    views[np.isnan(height)] = np.nan
    _write(folder, "views", relief(views, None, "views", cv2.COLORMAP_VIRIDIS))


def relief(
    values: Float[np.ndarray, "h w"],
    shade: UInt8[np.ndarray, "h w"] | None,
    unit: str,
    colors: int = cv2.COLORMAP_TURBO,
) -> UInt8[np.ndarray, "h2 w2 3"]:
    """Values in colors, darkened by a hill-shade, holes white, with a color bar to the right."""
    known = ~np.isnan(values)
    low, high = np.quantile(values[known], [0.005, 0.995]) if known.any() else (0.0, 1.0)
    high = max(high, low + 1e-9)
    level = (np.clip((np.nan_to_num(values, nan=low) - low) / (high - low), 0, 1) * 255).astype(np.uint8)
    image = cv2.applyColorMap(level, colors)[..., ::-1].astype(np.float64)
    if shade is not None:
        light = np.where(shade > 0, shade / 180.0, 1.0)  # level ground has 180
        image = image * np.clip(0.35 + 0.65 * light, 0, 1.25)[..., None]
    shown = _on_paper(np.clip(image, 0, 255).astype(np.uint8), known)
    return np.concatenate([shown, _color_bar(shown.shape[0], max(shown.shape), low, high, unit, colors)], 1)


def _color_bar(
    rows: int, long_side: int, low: float, high: float, unit: str, colors: int
) -> UInt8[np.ndarray, "rows columns 3"]:
    wide, size = max(8, round(_BAR * long_side)), max(0.35, long_side / 1600)
    top, bottom = min(rows // 4, round(52 * size) + 4), max(1, min(rows // 4, round(12 * size) + 4))
    bar = np.full((rows, wide * 2 + round(150 * size), 3), _PAPER, np.uint8)
    ramp = np.linspace(255, 0, max(2, rows - top - bottom)).astype(np.uint8)
    bar[top : top + len(ramp), wide : 2 * wide] = cv2.applyColorMap(ramp[:, None], colors)[..., ::-1]
    draw, decimals = np.ascontiguousarray(bar), 0 if unit == "views" else decimals_of((high - low) / (_MARKS - 1))
    for k in range(_MARKS):
        y = top + round((len(ramp) - 1) * (1 - k / (_MARKS - 1)))
        text = f"{low + (high - low) * k / (_MARKS - 1):.{decimals}f}"
        at = (2 * wide + 6, y + round(5 * size))
        cv2.putText(draw, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, (40, 40, 40), 1, cv2.LINE_AA)
    cv2.putText(
        draw, unit, (wide, top - round(18 * size) - 4), cv2.FONT_HERSHEY_SIMPLEX, size, (40, 40, 40), 1, cv2.LINE_AA
    )
    return draw


def decimals_of(step: float) -> int:
    """Decimals with which values that far apart differ in two digits."""
    return max(0, 1 - math.floor(math.log10(step)))


def _on_paper(image: UInt8[np.ndarray, "h w 3"], shown: np.ndarray) -> UInt8[np.ndarray, "h w 3"]:
    return np.where(shown[..., None], image, _PAPER).astype(np.uint8)


def _write(folder: Path, name: str, image: UInt8[np.ndarray, "h w 3"]) -> None:
    images.write_rgb(folder / f"preview_{name}.png", image)
