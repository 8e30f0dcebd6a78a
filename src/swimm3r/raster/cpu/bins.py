"""Sorting primitives into 16 x 16 tiles, front to back, without ever sorting the pairs (CPU).

Primitives are ordered by depth once (radix sort of the float bits) and scattered stably into their tiles. Which
4 x 4 blocks of which tiles an ellipse may touch is decided exactly: in a strip of rows it covers one interval of x.
Culling never changes the image: alpha >= alpha_min means r2 < 1 - (alpha_min / o)^(1/b) under the Beta kernel, and
r2 < ln(o / alpha_min) / b under the Gaussian.

A packed primitive is one cache line: mean (2), conic (3), log2 opacity, exponent, r2_max, depth, color (3), and what
`span` needs: half width, half height, y of the rightmost point from the center, determinant of the conic.
"""

import math
from typing import no_type_check

import numpy as np
import torch
from numba import njit

from swimm3r.raster.cpu.math import bits, inlined, prefetch
from swimm3r.raster.records import TILE, Bins, CpuBins, Kernel, Primitives2D

MEAN_X, MEAN_Y, CONIC_A, CONIC_B, CONIC_C, LOG2_O, EXPONENT, R2_MAX, DEPTH, COLOR = range(10)
HALF_WIDTH, HALF_HEIGHT, RIGHTMOST_Y, DETERMINANT = range(12, 16)

MARGIN = np.float32(1e-3)  # px: rounding must never lose a pixel; the kernels test r2 exactly anyway
AHEAD = 6  # primitives: their records are random reads here
ZERO, HALF, ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)


@no_type_check
@inlined
def span(p, inverse_a, y0, y1):
    """Interval of x, from the center, that a packed primitive covers where y0 <= y - center <= y1.

    The right end of a row is a concave function of y, so the strip's rightmost point lies where the whole ellipse's
    does, moved into the strip; the left end is the same mirrored.
    """
    half_height, offset, reach = p[HALF_HEIGHT], p[RIGHTMOST_Y], p[CONIC_A] * p[R2_MAX]
    low_y, high_y = max(min(y0, half_height), -half_height), max(min(y1, half_height), -half_height)
    y = min(max(offset, low_y), high_y)
    high = -p[CONIC_B] * y + math.sqrt(max(reach - p[DETERMINANT] * y * y, ZERO))
    y = min(max(-offset, low_y), high_y)
    low = -p[CONIC_B] * y - math.sqrt(max(reach - p[DETERMINANT] * y * y, ZERO))
    return low * inverse_a - MARGIN, high * inverse_a + MARGIN


@no_type_check
@inlined
def first_pixel(x, size):
    """Index of the first pixel whose center is at or right of x, within the image."""
    return math.ceil(min(max(x - HALF, ZERO), np.float32(size)))


@no_type_check
@inlined
def last_pixel(x, size):
    """Index of the last pixel whose center is at or left of x; -1 if there is none."""
    return math.floor(min(max(x - HALF, -ONE), np.float32(size - 1)))


@no_type_check
@njit(nogil=True, cache=True, error_model="numpy")
def pack(alpha_min, gaussian, height, width, packed, keys, mean2d, conic, color, opacity, beta, depth):
    """Packed records and depth keys; what cannot be seen gets the last key.

    Returns how many primitives can be seen, and more tiles than they can meet.
    """
    drawn, bound = 0, 0
    for i in range(len(opacity)):
        keys[i] = np.uint32(0xFFFFFFFF)
        x, y, z, o = mean2d[i, 0], mean2d[i, 1], depth[i], float(opacity[i])
        a, b, c = float(conic[i, 0]), float(conic[i, 1]), float(conic[i, 2])
        determinant = a * c - b * b  # in float64: thin ellipses cancel
        if not (0 < z < np.inf and 0 < a < np.inf and 0 < determinant < np.inf and beta[i] > 0):
            continue
        if not (o > 0 and o >= alpha_min and abs(x) < np.inf and abs(y) < np.inf):
            continue
        power = 1 / float(beta[i])
        r2_max = math.log(o / alpha_min) * power if gaussian else 1 - (alpha_min / o) ** power
        half_width, half_height = math.sqrt(r2_max * c / determinant), math.sqrt(r2_max * a / determinant)
        packed[i, MEAN_X], packed[i, MEAN_Y] = x, y
        packed[i, CONIC_A], packed[i, CONIC_B], packed[i, CONIC_C] = a, b, c
        packed[i, LOG2_O], packed[i, EXPONENT], packed[i, R2_MAX] = math.log2(o), beta[i], r2_max
        packed[i, DEPTH] = z
        for k in range(3):
            packed[i, COLOR + k] = color[i, k]
        packed[i, HALF_WIDTH], packed[i, HALF_HEIGHT] = half_width, half_height
        packed[i, RIGHTMOST_Y], packed[i, DETERMINANT] = -b * half_width / c, determinant
        keys[i] = np.uint32(bits(z))  # the bits of positive floats sort like the floats
        drawn += 1
        bound += (int(min(2 * half_width, width)) // TILE + 3) * (int(min(2 * half_height, height)) // TILE + 3)
    return drawn, bound


@no_type_check
@njit(nogil=True, cache=True, error_model="numpy")
def argsort_keys(keys):
    """Stable order of uint32 keys: three passes over 11 bits."""
    n = len(keys)
    order, scratch = np.arange(n).astype(np.int32), np.empty(n, np.int32)
    for shift in (0, 11, 22):
        start = np.zeros(2049, np.int64)
        for i in range(n):
            start[((keys[i] >> shift) & 2047) + 1] += 1
        for digit in range(2048):
            start[digit + 1] += start[digit]
        for r in range(n):
            digit = (keys[order[r]] >> shift) & 2047
            scratch[start[digit]] = order[r]
            start[digit] += 1
        order, scratch = scratch, order
    return order


@no_type_check
@njit(nogil=True, cache=True, error_model="numpy")
def scatter(packed, order, bound, height, width):
    """Tile lists and slots of the first len(order) primitives; at most `bound` pairs. See Bins and CpuBins."""
    rows, columns = (height + TILE - 1) // TILE, (width + TILE - 1) // TILE
    tile, mask = np.empty(bound, np.int32), np.empty(bound, np.int32)  # by primitive; pages never reached cost nothing
    first_slot = np.zeros(len(order) + 1, np.int32)
    tile_start = np.zeros(rows * columns + 1, np.int32)
    left, right = np.empty(4, np.int32), np.empty(4, np.int32)
    n = 0
    for r in range(len(order)):
        prefetch(packed, order[min(r + AHEAD, len(order) - 1)])
        p = packed[order[r]]
        x, y, half_height = p[MEAN_X], p[MEAN_Y], p[HALF_HEIGHT]
        inverse_a = ONE / p[CONIC_A]
        top = first_pixel(y - half_height - MARGIN, height)
        bottom = last_pixel(y + half_height + MARGIN, height)
        for row in range(top // TILE, bottom // TILE + 1):
            first, last = columns, -1
            for k in range(4):
                y0, y1 = max(top, row * TILE + 4 * k), min(bottom, row * TILE + 4 * k + 3)
                left[k], right[k] = 1, 0
                if y0 <= y1:
                    low, high = span(p, inverse_a, np.float32(y0) + HALF - y, np.float32(y1) + HALF - y)
                    left[k], right[k] = first_pixel(x + low, width) // 4, last_pixel(x + high, width) // 4
                    if left[k] <= right[k]:
                        first, last = min(first, left[k] // 4), max(last, right[k] // 4)
            for column in range(first, last + 1):
                blocks = 0
                for k in range(4):
                    low, high = max(left[k] - 4 * column, 0), min(right[k] - 4 * column, 3)
                    if low <= high:
                        blocks |= ((2 << high) - (1 << low)) << (4 * k)
                if blocks != 0:
                    tile[n], mask[n] = row * columns + column, blocks
                    tile_start[tile[n] + 1] += 1
                    n += 1
        first_slot[r + 1] = n
    for t in range(rows * columns):
        tile_start[t + 1] += tile_start[t]
    cursor = tile_start[:-1].copy()
    ids, blocks, slot = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.int32)
    for r in range(len(order)):
        for k in range(first_slot[r], first_slot[r + 1]):
            where = cursor[tile[k]]
            cursor[tile[k]] = where + 1
            ids[where], blocks[where], slot[where] = order[r], mask[k], k
    return tile_start, ids, blocks, slot, first_slot


def bin_primitives(p: Primitives2D, height: int, width: int, alpha_min: float, kernel: Kernel) -> Bins:
    """Tile lists of float32 primitives on the CPU."""
    n = len(p.depth)
    packed, keys = np.empty((n, 16), np.float32), np.empty(n, np.uint32)
    fields = [t.numpy() for t in p]
    drawn, bound = pack(alpha_min, kernel == "gaussian", height, width, packed, keys, *fields)
    order = argsort_keys(keys)[:drawn]
    lists = (torch.from_numpy(a) for a in (packed, order, *scatter(packed, order, bound, height, width)))
    records, by_depth, tile_start, ids, blocks, slot, first_slot = lists
    return Bins(height, width, alpha_min, kernel, records, tile_start, ids, CpuBins(by_depth, blocks, slot, first_slot))
