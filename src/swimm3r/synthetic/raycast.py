"""Exact intersection of rays with a heightfield.

The floor is the bilinear surface through heights on a square grid. A pyramid of the largest height per block lets a ray
jump over everything it passes above (Tevs, Ihrke & Seidel 2008, maximum mipmaps); in a cell that it may touch, the
surface along the ray is a parabola in the ray parameter, so the hit is a root of a quadratic, not a search.
"""

from dataclasses import dataclass
from typing import no_type_check

import numba
import numpy as np

MISS = -1.0


@dataclass(frozen=True)
class Heightfield:
    """Heights [m] at the nodes of a grid; node (row, column) is at (x0 + column * cell, y0 + row * cell)."""

    height: np.ndarray  # [n + 1, n + 1] float64, n a power of two
    pyramid: np.ndarray  # largest heights, all levels one after another
    x0: float
    y0: float
    cell: float


def heightfield(height: np.ndarray, x0: float, y0: float, cell: float) -> Heightfield:
    """A heightfield with its pyramid."""
    level = np.maximum(np.maximum(height[:-1, :-1], height[1:, :-1]), np.maximum(height[:-1, 1:], height[1:, 1:]))
    levels = [level.ravel()]
    while level.shape[0] > 1:
        n = level.shape[0] // 2
        level = level.reshape(n, 2, n, 2).max(axis=(1, 3))
        levels.append(level.ravel())
    return Heightfield(np.ascontiguousarray(height), np.concatenate(levels), x0, y0, cell)


@numba.njit(cache=True)
@no_type_check
def bilinear(grid: np.ndarray, gx: float, gy: float) -> float:
    """A grid's value at a place in units of cells."""
    n = grid.shape[0] - 2
    i, j = min(max(int(gx), 0), n), min(max(int(gy), 0), n)
    u, v = gx - i, gy - j
    return (grid[j, i] * (1 - u) + grid[j, i + 1] * u) * (1 - v) + (
        grid[j + 1, i] * (1 - u) + grid[j + 1, i + 1] * u
    ) * v


@numba.njit(cache=True)
@no_type_check
def _patch_hit(height: np.ndarray, i: int, j: int, u: float, v: float, z: float, d: np.ndarray, span: float) -> float:
    """Ray parameter in 0..span at which a ray that starts at (u, v) in cell (i, j) meets the bilinear patch."""
    a = height[j, i]
    b = height[j, i + 1] - a
    c = height[j + 1, i] - a
    e = height[j + 1, i + 1] - a - b - c
    qa = -e * d[0] * d[1]
    qb = d[2] - b * d[0] - c * d[1] - e * (u * d[1] + v * d[0])
    qc = z - a - b * u - c * v - e * u * v
    slack = 1e-9
    if abs(qa) < 1e-14:
        t = -qc / qb if qb != 0 else MISS
        return max(t, 0.0) if -slack <= t <= span + slack else MISS
    disc = qb * qb - 4 * qa * qc
    if disc < 0:
        return MISS
    q = -0.5 * (qb + np.sqrt(disc)) if qb >= 0 else -0.5 * (qb - np.sqrt(disc))
    t1 = q / qa
    t2 = qc / q if q != 0 else t1
    if t1 > t2:
        t1, t2 = t2, t1
    if -slack <= t1 <= span + slack:
        return max(t1, 0.0)
    if -slack <= t2 <= span + slack:
        return max(t2, 0.0)
    return MISS


@numba.njit(cache=True)
@no_type_check
def cast(
    height: np.ndarray, pyramid: np.ndarray, cell: float, origin: np.ndarray, direction: np.ndarray, start: float
) -> float:
    """Ray parameter t of the first hit of origin + t direction at or beyond `start`; MISS where there is none.

    The origin is relative to the grid's corner, in metres, above the surface.
    """
    n = height.shape[0] - 1
    top = 0
    while (1 << top) < n:
        top += 1
    gx0, gy0 = origin[0] / cell, origin[1] / cell
    d = np.empty(3)
    d[0], d[1], d[2] = direction[0] / cell, direction[1] / cell, direction[2]
    # where the ray is over the grid and below its highest point
    enter, leave = start, 1e9
    for axis in range(2):
        o = gx0 if axis == 0 else gy0
        if d[axis] == 0:
            if o < 0 or o > n:
                return MISS
        else:
            t1, t2 = -o / d[axis], (n - o) / d[axis]
            enter, leave = max(enter, min(t1, t2)), min(leave, max(t1, t2))
    highest = pyramid[-1]
    if d[2] != 0:
        t = (highest - origin[2]) / d[2]
        if d[2] > 0:
            leave = min(leave, t)
        else:
            enter = max(enter, t)
    elif origin[2] > highest:
        return MISS
    t = enter
    level = min(4, top)
    while t < leave:
        # a hair further, so that a place on a border belongs to the cell ahead
        ahead = t + 1e-9
        x, y = gx0 + ahead * d[0], gy0 + ahead * d[1]
        size = 1 << level
        blocks = n >> level
        i, j = int(np.floor(x / size)), int(np.floor(y / size))
        if i < 0 or j < 0 or i >= blocks or j >= blocks:
            return MISS
        exit_ = leave
        if d[0] != 0:
            exit_ = min(exit_, ((i + (1 if d[0] > 0 else 0)) * size - gx0) / d[0])
        if d[1] != 0:
            exit_ = min(exit_, ((j + (1 if d[1] > 0 else 0)) * size - gy0) / d[1])
        exit_ = max(exit_, ahead)
        lowest = min(origin[2] + t * d[2], origin[2] + exit_ * d[2])
        offset = (4 * n * n - 4 * blocks * blocks) // 3  # of this level: n^2 + (n/2)^2 + ... before it
        if lowest > pyramid[offset + j * blocks + i]:
            t = exit_
            level = min(level + 1, top)
        elif level > 0:
            level -= 1
        else:
            found = _patch_hit(height, i, j, gx0 + t * d[0] - i, gy0 + t * d[1] - j, origin[2] + t * d[2], d, exit_ - t)
            if found >= 0:
                return t + found
            t = exit_
    return MISS
