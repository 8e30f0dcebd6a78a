"""Elevation of a tile: the weighted median over the depth maps that show a cell from above, and what it rests on.

    std = 1.4826 median |h_k - h|    over the views k of a cell: the spread of one view, NaN for a single view

A cell that no depth map shows stays a hole.
"""

from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float, Float32, UInt8, UInt16

from swimm3r.products.depth_surface import seen_from_above
from swimm3r.products.grid import Grid, Window
from swimm3r.products.survey import Survey

LAYERS = 32  # views that a median is taken over, the nearest ones
_SUN = (315.0, 45.0)  # azimuth from north and height of the light of a hill-shade, degrees: the cartographer's custom
_MAD = 1.4826  # from the median absolute deviation to the standard deviation of a normal distribution


@dataclass(frozen=True)
class Elevation:
    """The cells of one window."""

    height: Float[np.ndarray, "h w"]  # local, NaN in holes; float64
    std: Float32[np.ndarray, "h w"]  # of one view; NaN in holes and for a single view
    confidence: Float32[np.ndarray, "h w"]  # mean of the views, 0..1; 0 in holes
    views: UInt16[np.ndarray, "h w"]


def elevation(survey: Survey, grid: Grid, window: Window, frames: list[int], min_views: int = 1) -> Elevation:
    """Heights at the cells of a window by these frames, nearest first (`frames_over`)."""
    shape = (window.rows, window.columns)
    layers = min(LAYERS, len(frames))
    heights = np.full((layers, *shape), np.nan, np.float64)
    weights = np.zeros((layers, *shape), np.float32)
    views = np.zeros(shape, np.uint16)
    for i in frames:
        top, confidence = seen_from_above(survey.points(i), grid, window, survey.footprint)
        _push(top, confidence, heights, weights, views)
    height, std, confidence = _medians(heights, weights, views, min_views)
    views = np.where(np.isnan(height), 0, views).astype(np.uint16)
    return Elevation(height, std * np.float32(_MAD), confidence, views)


def frames_over(survey: Survey, grid: Grid, window: Window) -> list[int]:
    """The frames whose surface may reach into a window, those whose camera is nearest to its middle first."""
    low = np.array([grid.x0 + window.column * grid.gsd, grid.y1 - (window.row + window.rows) * grid.gsd])
    high = low + np.array([window.columns, window.rows]) * grid.gsd
    middle = (low + high) / 2
    found = []
    for i, points in survey.overview.items():
        least, most = points[:, :2].min(0), points[:, :2].max(0)
        slack = 0.1 * (most - least)  # the overview leaves out the borders
        if (most + slack >= low).all() and (least - slack <= high).all():
            found.append((float(np.linalg.norm(survey.centers[i, :2] - middle)), i))
    return [i for _, i in sorted(found)]


def hill_shade(height: Float[np.ndarray, "h w"], gsd: float) -> UInt8[np.ndarray, "h w"]:
    """Light on the surface from the north-west, 1..255; 0 in holes and where a neighbor is one."""
    east, north = gradients(height, gsd)
    azimuth, above = np.radians(_SUN)
    sun = np.array([np.sin(azimuth) * np.cos(above), np.cos(azimuth) * np.cos(above), np.sin(above)])
    light = (-east * sun[0] - north * sun[1] + sun[2]) / np.sqrt(1 + east**2 + north**2)
    return np.where(np.isnan(light), 0, 1 + np.clip(light, 0, 1) * 254).astype(np.uint8)


def gradients(
    height: Float[np.ndarray, "h w"], gsd: float
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Slopes to the east and to the north (Horn 1981); NaN at the border and beside holes."""
    padded = np.pad(height, 1, constant_values=np.nan)
    nw, n, ne = padded[:-2, :-2], padded[:-2, 1:-1], padded[:-2, 2:]
    w, e = padded[1:-1, :-2], padded[1:-1, 2:]
    sw, s, se = padded[2:, :-2], padded[2:, 1:-1], padded[2:, 2:]
    east = ((ne + 2 * e + se) - (nw + 2 * w + sw)) / (8 * gsd)
    north = ((nw + 2 * n + ne) - (sw + 2 * s + se)) / (8 * gsd)
    return east, north


@numba.njit(cache=True, nogil=True)
@no_type_check
def _push(top, confidence, heights, weights, views):
    """Add a view to the layers of the cells that it shows; those that have enough count it only."""
    for row in range(top.shape[0]):
        for column in range(top.shape[1]):
            if np.isnan(top[row, column]):
                continue
            layer = views[row, column]
            if layer < heights.shape[0]:
                heights[layer, row, column] = top[row, column]
                weights[layer, row, column] = max(confidence[row, column], 1e-3)
            views[row, column] += 1


@numba.njit(cache=True, nogil=True)
@no_type_check
def _medians(heights, weights, views, min_views):
    """Weighted median of each cell, median absolute deviation from it, mean weight."""
    layers, rows, columns = heights.shape
    middle = np.full((rows, columns), np.nan)
    spread = np.full((rows, columns), np.nan, np.float32)
    confidence = np.zeros((rows, columns), np.float32)
    away = np.empty(layers)
    for row in range(rows):
        for column in range(columns):
            if views[row, column] < max(min_views, 1):
                continue
            n = min(layers, views[row, column])
            values, shares = heights[:n, row, column], weights[:n, row, column]
            middle[row, column] = _weighted_median(values, shares)
            confidence[row, column] = shares.mean()
            if n > 1:
                for k in range(n):
                    away[k] = abs(values[k] - middle[row, column])
                spread[row, column] = np.median(away[:n])
    return middle, spread, confidence


@numba.njit(cache=True, nogil=True)
@no_type_check
def _weighted_median(values, weights):
    """The value with half of the weight on either side, between neighbors by the weight that is missing."""
    order = np.argsort(values)
    total = weights.sum()
    below = 0.0
    for k in range(len(order)):
        half = below + weights[order[k]] / 2
        if half >= total / 2:
            if k == 0:
                return values[order[0]]
            before = below - weights[order[k - 1]] / 2
            share = (total / 2 - before) / (half - before)
            return values[order[k - 1]] + share * (values[order[k]] - values[order[k - 1]])
        below += weights[order[k]]
    return values[order[len(order) - 1]]
