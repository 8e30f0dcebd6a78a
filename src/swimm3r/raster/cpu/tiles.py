"""Inner loops of both passes over a tile on the CPU: pixels of a block, which LLVM turns into SIMD.

A tile's 256 pixels live in a workspace, one row per quantity, in the order of its 4 x 4 blocks: a block is one vector
of 512 bits where the machine has them. Only the blocks that an ellipse may touch, and that have not ended, are gone
through. Loops over their pixels stay vectorized by (docs/derivations/raster-kernels.md, asserted by tests) a
one-dimensional workspace, unsigned indices, constant row offsets, float32 constants, and no call that is not inlined.
Short loops one after the other beat one long loop: fewer values spill, and the long chain of the coverage overlaps with
itself.

The water varies little within a tile, so e^{-beta z} is that of the tile's middle, which all pixels share, times what a
pixel's departure from it makes: a short polynomial (`through_water`).
"""

import zlib
from pathlib import Path
from typing import no_type_check

import numpy as np
from numba import njit

from swimm3r.raster import pairmath
from swimm3r.raster.cpu import bins, math
from swimm3r.raster.cpu.math import any_positive, disordered, lowest_bit, maximum, minimum, ordered, select, vec3
from swimm3r.raster.records import TILE

_pair = pairmath.make(math.inlined, math.exp2, math.log2, minimum, maximum, select, vec3, np.float32)
half_slope, squared_distance, coverage = _pair.half_slope, _pair.squared_distance, _pair.coverage
beta_falloff, gaussian_falloff = _pair.beta_falloff, _pair.gaussian_falloff
advance, transmittance = _pair.advance, _pair.transmittance
seen_color, color_slope, payloads = _pair.seen_color, _pair.color_slope, _pair.payloads
shape_slopes, depth_slope = _pair.shape_slopes, _pair.depth_slope
transmittance_near_one = pairmath.make(
    math.inlined, math.exp2_near_zero, math.log2, minimum, maximum, select, vec3, np.float32
).transmittance

# Numba's cache looks at the kernel's own file only. The sources that are inlined into a kernel, this one among them,
# enter its signature through this number, the default of an argument nobody passes: editing pairmath.py recompiles.
_INLINED = (str(pairmath.__file__), str(math.__file__), str(bins.__file__), __file__)
SOURCES = zlib.crc32(b"".join(Path(source).read_bytes() for source in _INLINED))

PIXELS, BLOCKS = TILE * TILE, 16
BLOCK = np.uintp(PIXELS // BLOCKS)
LINE = 16  # floats in a cache line
STRIDE = PIXELS + LINE  # rows 4 KiB apart would share cache sets, and loads would wait for stores to another row
AHEAD = 6  # pairs: the packed records are random reads from L3
CHECK = 8  # pairs between two looks which blocks have ended
UP1, UP2, UP3, UP4, UP5 = (np.uintp(k) for k in range(1, 6))
NEG_LOG2_E, LN_2 = np.float32(-pairmath.LOG2_E), np.float32(pairmath.LN_2)
ZERO, HALF, ONE, TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)

# Rows of the workspace: pixel center, transmittance, the water's exponents less those of the tile's middle, B_inf
# (adjoint: dL/dI B_inf)
X, Y, T, KB0, KB1, KB2, KD0, KD1, KD2, B0, B1, B2 = (np.uintp(STRIDE * k) for k in range(12))
MIDDLE = X + np.uintp(PIXELS)  # in a gap between rows: the six exponents of the tile's middle
OWN_ROWS = 12  # from here on rows are those of a sweep

kernel = njit(nogil=True, cache=True, error_model="numpy", fastmath=math.FLAGS)


@no_type_check
@math.inlined
def falloff(r2, gaussian):
    """(u, l) of a kernel; None for `gaussian` is the Beta kernel, and leaves the other out of what is compiled."""
    if gaussian is None:
        return beta_falloff(r2)
    return gaussian_falloff(r2)


@no_type_check
@math.inlined
def workspace(rows):
    """Rows that begin on cache lines: a vector that lies across two of them takes two loads."""
    raw = np.zeros(rows * STRIDE + LINE, np.float32)
    return raw[(-raw.ctypes.data % (4 * LINE)) // 4 :]


@no_type_check
@math.inlined
def block_order(y, x):
    """Workspace column of pixel (y, x) of a tile; unsigned, as a sign would have to be looked at."""
    return np.uintp(64 * (y >> 2) + 16 * (x >> 2) + 4 * (y & 3) + (x & 3))


@no_type_check
@math.inlined
def copy_four(source, i, target, j):
    """Copy four neighbors: all reads before all writes, or LLVM would fear that they overlap, and go one by one."""
    a, b, c, d = source[i], source[i + UP1], source[i + UP2], source[i + UP3]
    target[j], target[j + UP1], target[j + UP2], target[j + UP3] = a, b, c, d


@no_type_check
@math.inlined
def gather(ws, row, image, tile_y, tile_x):
    """Copy one tile of an image into a row; beyond the image its edge repeats."""
    height, width = image.shape
    flat = image.ravel()
    for y in range(TILE):
        line = min(tile_y + y, height - 1) * width
        if tile_x + TILE <= width:
            for x in range(0, TILE, 4):
                copy_four(flat, np.uintp(line + tile_x + x), ws, row + block_order(y, x))
        else:
            for x in range(TILE):
                ws[row + block_order(y, x)] = flat[np.uintp(line + min(tile_x + x, width - 1))]


@no_type_check
@math.inlined
def put_back(ws, row, image, tile_y, tile_x):
    """Copy a row into its tile of an image."""
    height, width = image.shape
    flat = image.ravel()
    for y in range(min(TILE, height - tile_y)):
        line = (tile_y + y) * width
        if tile_x + TILE <= width:
            for x in range(0, TILE, 4):
                copy_four(ws, row + block_order(y, x), flat, np.uintp(line + tile_x + x))
        else:
            for x in range(width - tile_x):
                flat[np.uintp(line + tile_x + x)] = ws[row + block_order(y, x)]


@no_type_check
@math.inlined
def centerd(ws):
    """Move the middle of the water's exponents from its rows to MIDDLE; returns the largest departure left."""
    spread = ZERO
    for k in range(6):
        row = KB0 + np.uintp(k * STRIDE)
        least = most = ordered(ws[row])
        for q in range(row, row + np.uintp(PIXELS)):
            value = ordered(ws[q])
            least, most = min(least, value), max(most, value)
        middle = HALF * (disordered(least) + disordered(most))
        for q in range(row, row + np.uintp(PIXELS)):
            ws[q] -= middle
        ws[MIDDLE + np.uintp(k)] = middle
        spread = maximum(spread, maximum(disordered(most) - middle, middle - disordered(least)))
    return spread


@no_type_check
@math.inlined
def channels(matrix, i, column):
    """Three neighbors in a row."""
    column = np.uintp(column)
    return matrix[i, column], matrix[i, column + UP1], matrix[i, column + UP2]


@no_type_check
@math.inlined
def plus(a, b):
    """Sum of two times three channels."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@no_type_check
@math.inlined
def middle_of(ws):
    """Exponents of backscatter and of attenuation in the tile's middle."""
    return (
        (ws[MIDDLE], ws[MIDDLE + UP1], ws[MIDDLE + UP2]),
        (ws[MIDDLE + UP3], ws[MIDDLE + UP4], ws[MIDDLE + UP5]),
    )


@no_type_check
@math.inlined
def through_water(departure, z, middle, at_middle, far):
    """e^{-beta z} per channel: that of the tile's middle times 2^(departure z).

    Where |departure z| <= 1/2, that factor is the polynomial inside of exp2, without what brings it into this range:
    two roundings more than exp2 of the sum, which is what pairs beyond take (`far` is not None).
    """
    if far is None:
        E = transmittance_near_one(departure, z)
        return at_middle[0] * E[0], at_middle[1] * E[1], at_middle[2] * E[2]
    return transmittance(plus(middle, departure), z)


@no_type_check
@math.inlined
def begin_tile(ws, tile_y, tile_x, height, width, Binf, beta_D, beta_B):
    """Pixel centers, T = 1, B_inf, and the water around its middle, which is returned (`centerd`)."""
    for y in range(TILE):
        for x in range(TILE):
            q = block_order(y, x)
            ws[X + q], ws[Y + q] = np.float32(x) + HALF, np.float32(y) + HALF
            # a pixel outside the image has ended before it begins
            ws[T + q] = ONE if tile_y + y < height and tile_x + x < width else -ONE
    if Binf is None:
        return ZERO
    for k in range(3):
        row = np.uintp(k * STRIDE)
        gather(ws, B0 + row, Binf[k], tile_y, tile_x)
        gather(ws, KB0 + row, beta_B[k], tile_y, tile_x)
        gather(ws, KD0 + row, beta_D[k], tile_y, tile_x)
    for q in range(KB0, B0):
        ws[q] *= NEG_LOG2_E
    return centerd(ws)


@no_type_check
@math.inlined
def live_blocks(ws):
    """Mask of the blocks in which some pixel can still change."""
    live = np.int32(0)
    for k in range(BLOCKS):
        if any_positive(ws, T + BLOCK * np.uintp(k)):
            live |= np.int32(1) << np.int32(k)
    return live


@no_type_check
@math.inlined
def list_blocks(mask, first):
    """Write down the first pixel of every block of a mask; returns how many there are."""
    n = 0
    while mask != 0:
        first[n] = BLOCK * np.uintp(lowest_bit(mask))
        mask &= mask - np.int32(1)
        n += 1
    return n
