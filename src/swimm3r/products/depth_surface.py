"""Depth maps seen from above: the surface between neighboring pixels, as triangles, sampled at the cells of a grid.

Of what lies above each other the highest counts. Triangles across a step in depth belong to no surface, nor do those
that a grazing ray stretches over the ground, where a pixel shows many times what it does straight below.
"""

from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float

from swimm3r.products.grid import Grid, Window
from swimm3r.products.survey import SurfacePoints

_STEP = 0.05  # of the depth, between neighboring pixels of a surface: one that the ray meets at 86 degrees
_LONGEST = 8.0  # footprints of a pixel, or cells where they are larger, along the side of a triangle


def seen_from_above(
    points: SurfacePoints, grid: Grid, window: Window, footprint: float
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Heights and confidence at the cells of a window by one depth map; NaN and 0 where it shows none.

    `footprint` is the size of a pixel on the ground, as a rule.
    """
    at = grid.cells(points.xyz[..., :2]) - np.array([window.column, window.row], np.float64)
    top = np.full((window.rows, window.columns), np.nan, np.float64)
    confidence = np.zeros((window.rows, window.columns), np.float32)
    _draw(
        np.ascontiguousarray(at), np.ascontiguousarray(points.xyz[..., 2]), points.z_depth.astype(np.float64),
        points.confidence.astype(np.float32), points.usable, _LONGEST * max(1.0, footprint / grid.gsd), top, confidence,
    )  # fmt: skip
    return top, confidence


@numba.njit(cache=True, nogil=True)
@no_type_check
def _draw(at, height, depth, confidence, usable, longest, top, top_confidence):
    rows, columns = depth.shape
    high, wide = top.shape
    corner_row = np.empty(3, np.int64)
    corner_column = np.empty(3, np.int64)
    for i in range(rows - 1):
        for j in range(columns - 1):
            x = at[i, j, 0]
            y = at[i, j, 1]
            if not (-longest <= x <= wide + longest and -longest <= y <= high + longest):
                continue
            for half in range(2):
                if half == 0:
                    corner_row[0], corner_row[1], corner_row[2] = i, i, i + 1
                    corner_column[0], corner_column[1], corner_column[2] = j, j + 1, j
                else:
                    corner_row[0], corner_row[1], corner_row[2] = i, i + 1, i + 1
                    corner_column[0], corner_column[1], corner_column[2] = j + 1, j + 1, j
                _triangle(
                    at, height, depth, confidence, usable, corner_row, corner_column, longest, top, top_confidence
                )


@numba.njit(cache=True, nogil=True)
@no_type_check
def _triangle(at, height, depth, confidence, usable, r, c, longest, top, top_confidence):
    near, far = np.inf, 0.0
    for k in range(3):
        if not usable[r[k], c[k]]:
            return
        near = min(near, depth[r[k], c[k]])
        far = max(far, depth[r[k], c[k]])
    if far - near > _STEP * near:
        return
    x0, y0 = at[r[0], c[0], 0], at[r[0], c[0], 1]
    x1, y1 = at[r[1], c[1], 0], at[r[1], c[1], 1]
    x2, y2 = at[r[2], c[2], 0], at[r[2], c[2], 1]
    west, east = min(x0, x1, x2), max(x0, x1, x2)
    north, south = min(y0, y1, y2), max(y0, y1, y2)
    twice = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    if abs(twice) < 1e-9 or east - west > longest or south - north > longest:
        return
    for row in range(max(0, int(np.ceil(north - 0.5))), min(top.shape[0] - 1, int(np.floor(south - 0.5))) + 1):
        for column in range(max(0, int(np.ceil(west - 0.5))), min(top.shape[1] - 1, int(np.floor(east - 0.5))) + 1):
            x, y = column + 0.5, row + 0.5
            b = ((x - x0) * (y2 - y0) - (x2 - x0) * (y - y0)) / twice
            d = ((x1 - x0) * (y - y0) - (x - x0) * (y1 - y0)) / twice
            a = 1 - b - d
            if a < -1e-9 or b < -1e-9 or d < -1e-9:
                continue
            z = a * height[r[0], c[0]] + b * height[r[1], c[1]] + d * height[r[2], c[2]]
            if not z <= top[row, column]:  # NaN where nothing was yet
                top[row, column] = z
                top_confidence[row, column] = (
                    a * confidence[r[0], c[0]] + b * confidence[r[1], c[1]] + d * confidence[r[2], c[2]]
                )
