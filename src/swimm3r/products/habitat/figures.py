"""Habitat figures of a surface given by heights on a square lattice: area, rugosity, slope, ruggedness, dimension.

    rugosity                  surface area / planar area                        (Dahl 1973)
    slope-corrected rugosity  surface area / area of the plane fitted to it     (Du Preez 2015)
    chain rugosity            length of a profile / its straight length         (Risk 1972), mean of four directions
    vector ruggedness         1 - |sum n| / N, n the unit normals               (Sappington et al. 2007)
    fractal dimension         3 - s / 2, s the slope of log variogram against log distance  (Burrough 1981)

The surface of a square between four heights is the mean of its two ways to be cut into triangles. Holes take no part.
Every figure but slope and aspect depends on the distance of the heights, which is stated beside it.
"""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float

LEAST_SQUARES = 16  # between four known heights each, below which an area has no figures
_LEVEL_DEG = 0.1  # slope below which a surface faces nowhere
_LEAST_PAIRS = 50  # of heights at one distance
_LEAST_LAGS = 3  # distances that a slope of the variogram is taken over
_LONGEST_LAG = 0.25  # of the area's shorter side: beyond it, too few pairs are independent


@dataclass(frozen=True)
class Figures:
    """Figures of one area; lengths in the unit of its heights, None where the area is too small for a figure."""

    coverage: float  # measured share
    planar_area: float
    surface_area: float
    rugosity: float
    slope_corrected_rugosity: float
    chain_rugosity: float | None
    slope_deg: float  # of the fitted plane
    aspect_deg: float | None  # down the slope, clockwise from north; None on level ground
    mean_slope_deg: float  # of the surface
    vector_ruggedness: float
    fractal_dimension: float | None
    relief: float  # highest less lowest
    mean_height: float
    height_std: float  # about the mean


NAMES = tuple(field.name for field in fields(Figures))
LENGTHS = {"planar_area": 2, "surface_area": 2, "relief": 1, "mean_height": 1, "height_std": 1}
"""Figures with a unit, and its power."""


def figures(
    height: Float[np.ndarray, "h w"], spacing: float, inside: Bool[np.ndarray, "h1 w1"] | None = None
) -> Figures | None:
    """The figures of the squares between heights (first row in the north) that lie inside; None where too few do.

    `inside` has one row and one column less than the heights; None is all of them.
    """
    known = ~(np.isnan(height[:-1, :-1]) | np.isnan(height[:-1, 1:]) | np.isnan(height[1:, :-1]))
    known &= ~np.isnan(height[1:, 1:])
    wanted = np.ones(known.shape, bool) if inside is None else inside
    squares = known & wanted
    if squares.sum() < LEAST_SQUARES:
        return None
    at = _corners(squares)
    east, north = _square_slopes(height, spacing)
    gx, gy = east[squares], north[squares]
    planar, surface = squares.sum() * spacing**2, _surface_area(height, spacing, squares)
    plane = _plane(height, spacing, at)
    tilt = float(np.hypot(*plane))
    normals = np.stack([-gx, -gy, np.ones_like(gx)]) / np.sqrt(1 + gx**2 + gy**2)
    slope, values = float(np.degrees(np.arctan(tilt))), height[at]
    return Figures(
        coverage=float(squares.sum() / wanted.sum()),
        planar_area=float(planar),
        surface_area=surface,
        rugosity=surface / planar,
        slope_corrected_rugosity=surface / (planar * np.sqrt(1 + tilt**2)),
        chain_rugosity=chain_rugosity(np.where(at, height, np.nan), spacing),
        slope_deg=slope,
        aspect_deg=None if slope < _LEVEL_DEG else float(np.degrees(np.arctan2(-plane[0], -plane[1])) % 360),
        mean_slope_deg=float(np.degrees(np.arctan(np.hypot(gx, gy))).mean()),
        vector_ruggedness=float(1 - np.linalg.norm(normals.sum(1)) / normals.shape[1]),
        fractal_dimension=fractal_dimension(np.where(at, height - _on_plane(height, spacing, plane), np.nan)),
        relief=float(np.ptp(values)),
        mean_height=float(values.mean()),
        height_std=float(values.std()),
    )


def chain_rugosity(height: Float[np.ndarray, "h w"], spacing: float) -> float | None:
    """Length of profiles over their straight length, mean of the directions E, N, NE and SE; None without any."""
    ratios = []
    for row, column in ((0, 1), (1, 0), (1, 1), (1, -1)):
        step = spacing * np.hypot(row, column)
        rise = _differences(height, row, column)
        rise = rise[~np.isnan(rise)]
        if len(rise) >= LEAST_SQUARES:
            ratios.append(float(np.sqrt(step**2 + rise**2).mean() / step))
    return float(np.mean(ratios)) if ratios else None


def fractal_dimension(height: Float[np.ndarray, "h w"]) -> float | None:
    """Dimension of a surface by its variogram along rows and columns; None where it is too small or exactly flat."""
    longest, lags, variogram = int(_LONGEST_LAG * min(height.shape)), [], []
    lag = 1
    while lag <= longest:
        pairs = np.concatenate([_differences(height, 0, lag).ravel(), _differences(height, lag, 0).ravel()])
        pairs = pairs[~np.isnan(pairs)]
        if len(pairs) >= _LEAST_PAIRS and (pairs**2).mean() > 0:
            lags.append(lag)
            variogram.append(float((pairs**2).mean()))
        lag = max(lag + 1, round(lag * 1.5))
    if len(lags) < _LEAST_LAGS:
        return None
    return float(3 - np.polyfit(np.log(lags), np.log(variogram), 1)[0] / 2)


def _differences(height: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Heights less those a number of rows and columns before."""
    if columns < 0:
        return _differences(height[:, ::-1], rows, -columns)
    return height[rows:, columns:] - height[: height.shape[0] - rows, : height.shape[1] - columns]


def _corners(squares: Bool[np.ndarray, "h1 w1"]) -> Bool[np.ndarray, "h w"]:
    """The heights at the corners of squares."""
    at = np.zeros((squares.shape[0] + 1, squares.shape[1] + 1), bool)
    for row in (0, 1):
        for column in (0, 1):
            at[row : row + squares.shape[0], column : column + squares.shape[1]] |= squares
    return at


def _square_slopes(height: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Slopes to the east and to the north in the middle of each square."""
    nw, ne, sw, se = height[:-1, :-1], height[:-1, 1:], height[1:, :-1], height[1:, 1:]
    return (ne + se - nw - sw) / (2 * spacing), (nw + ne - sw - se) / (2 * spacing)


def _surface_area(height: np.ndarray, spacing: float, squares: np.ndarray) -> float:
    """Area of the squares, each cut into triangles along either diagonal."""
    nw, ne, sw, se = (part[squares] for part in (height[:-1, :-1], height[:-1, 1:], height[1:, :-1], height[1:, 1:]))
    total = 0.0
    for east, north in (((ne - nw), (nw - sw)), ((se - sw), (ne - se)), ((ne - nw), (ne - se)), ((se - sw), (nw - sw))):
        total += float(np.sqrt(spacing**2 + east**2 + north**2).sum())  # twice a triangle's area, by spacing
    return total * spacing / 4


def _plane(height: np.ndarray, spacing: float, at: np.ndarray) -> Float[np.ndarray, "2"]:
    """Slopes to the east and to the north of the plane fitted to some of the heights."""
    row, column = np.nonzero(at)
    x, y = (column - column.mean()) * spacing, -(row - row.mean()) * spacing
    z = height[at] - height[at].mean()
    return np.linalg.lstsq(np.stack([x, y], 1), z, rcond=None)[0]


def _on_plane(height: np.ndarray, spacing: float, plane: np.ndarray) -> np.ndarray:
    """A plane of these slopes, through 0 at the first height."""
    row, column = np.indices(height.shape)
    return spacing * (plane[0] * column - plane[1] * row)
