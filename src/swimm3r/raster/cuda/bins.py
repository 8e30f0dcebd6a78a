"""Tile lists by two Warp kernels of one thread per primitive, and a sort, on the device of the primitives.

The first kernel counts the tiles that each ellipse may touch, the second lists them; both go through the ellipse's tile
rows, in each of which it covers one interval of x (`raster.cpu.bins.span`). In float64, as thin ellipses cancel.
"""

from typing import Any, no_type_check

import torch
import warp as wp

from swimm3r.raster.cuda.launch import launch
from swimm3r.raster.records import TILE, Bins, Kernel, Primitives2D

MARGIN = wp.constant(wp.float64(1e-3))  # px: rounding must never lose a pixel; the kernels test r2 exactly anyway
SIDE = wp.constant(TILE)
ZERO, HALF, ONE = (wp.constant(wp.float64(value)) for value in (0.0, 0.5, 1.0))


class _Ellipse:
    """The pixels in which a primitive may be opaque enough, by their bounds."""

    seen: int  # 0: none
    x: wp.float64  # of the center
    y: wp.float64
    a: wp.float64  # of the conic
    b: wp.float64
    determinant: wp.float64
    r2_max: wp.float64
    rightmost_y: wp.float64  # from the center
    first_x: int
    last_x: int
    first_y: int
    last_y: int


Ellipse: Any = wp.struct(_Ellipse)


@no_type_check
@wp.func
def first_pixel(x: wp.float64, size: int):
    """Index of the first pixel whose center is at or right of x, within the image."""
    return int(wp.ceil(wp.clamp(x - HALF, ZERO, wp.float64(size))))


@no_type_check
@wp.func
def last_pixel(x: wp.float64, size: int):
    """Index of the last pixel whose center is at or left of x; -1 if there is none."""
    return int(wp.floor(wp.clamp(x - HALF, -ONE, wp.float64(size - 1))))


@no_type_check
@wp.func
def ellipse_of(
    i: int, width: int, height: int, alpha_min: wp.float64, gaussian: int,
    mean2d: wp.array2d(dtype=float), conic: wp.array2d(dtype=float), opacity: wp.array(dtype=float),
    beta: wp.array(dtype=float), depth: wp.array(dtype=float),
):  # fmt: skip
    """Of primitive i; not seen where a number of it is none."""
    out = Ellipse()
    out.x = wp.float64(mean2d[i, 0])
    out.y = wp.float64(mean2d[i, 1])
    out.a = wp.float64(conic[i, 0])
    out.b = wp.float64(conic[i, 1])
    c, o, exponent = wp.float64(conic[i, 2]), wp.float64(opacity[i]), wp.float64(beta[i])
    out.determinant = out.a * c - out.b * out.b
    finite = wp.isfinite(depth[i]) and wp.isfinite(out.x) and wp.isfinite(out.y)
    finite = finite and wp.isfinite(out.a) and wp.isfinite(out.determinant)
    positive = depth[i] > 0.0 and out.a > ZERO and out.determinant > ZERO and exponent > ZERO and o > ZERO
    out.seen = 0
    if finite and positive and o >= alpha_min:
        if gaussian != 0:
            out.r2_max = wp.log(o / alpha_min) / exponent
        else:
            out.r2_max = ONE - wp.pow(alpha_min / o, ONE / exponent)
        half_width = wp.sqrt(wp.max(out.r2_max * c / out.determinant, ZERO)) + MARGIN
        half_height = wp.sqrt(wp.max(out.r2_max * out.a / out.determinant, ZERO)) + MARGIN
        out.rightmost_y = -out.b * half_width / c
        out.first_x = first_pixel(out.x - half_width, width)
        out.last_x = last_pixel(out.x + half_width, width)
        out.first_y = first_pixel(out.y - half_height, height)
        out.last_y = last_pixel(out.y + half_height, height)
        if out.first_x <= out.last_x and out.first_y <= out.last_y:
            out.seen = 1
    return out


@no_type_check
@wp.func
def tiles_of_row(e: Ellipse, row: int):
    """First and last column of the tiles that an ellipse may touch in a row of tiles; where it touches none, the last
    is before the first.

    The right end of a row of pixels is a concave function of y, so the rightmost point lies where the whole ellipse's
    does, moved into the row of tiles; the left end is the same mirrored.
    """
    low = wp.float64(wp.max(row * SIDE, e.first_y)) + HALF - e.y
    high = wp.float64(wp.min(row * SIDE + SIDE - 1, e.last_y)) + HALF - e.y
    reach = e.a * e.r2_max
    y = wp.clamp(e.rightmost_y, low, high)
    right = e.x + (-e.b * y + wp.sqrt(wp.max(reach - e.determinant * y * y, ZERO))) / e.a + MARGIN
    y = wp.clamp(-e.rightmost_y, low, high)
    left = e.x + (-e.b * y - wp.sqrt(wp.max(reach - e.determinant * y * y, ZERO))) / e.a - MARGIN
    first = int(wp.max(wp.float64(e.first_x), wp.ceil(left - HALF))) // SIDE
    last = int(wp.min(wp.float64(e.last_x), wp.floor(right - HALF))) // SIDE
    return first, wp.max(last, first - 1)


@no_type_check
@wp.kernel(enable_backward=False)
def count_tiles(
    mean2d: wp.array2d(dtype=float), conic: wp.array2d(dtype=float), color: wp.array2d(dtype=float),
    opacity: wp.array(dtype=float), beta: wp.array(dtype=float), depth: wp.array(dtype=float),
    width: int, height: int, alpha_min: wp.float64, gaussian: int,
    packed: wp.array2d(dtype=float), counts: wp.array(dtype=wp.int64),
):  # fmt: skip
    """The number of tiles of each primitive, and what the passes read of those that are seen."""
    i = wp.tid()
    e = ellipse_of(i, width, height, alpha_min, gaussian, mean2d, conic, opacity, beta, depth)
    count = wp.int64(0)
    if e.seen != 0:
        for row in range(e.first_y // SIDE, e.last_y // SIDE + 1):
            first, last = tiles_of_row(e, row)
            count += wp.int64(last - first + 1)
        for k in range(2):
            packed[i, k] = mean2d[i, k]
        for k in range(3):
            packed[i, 2 + k] = conic[i, k]
            packed[i, 9 + k] = color[i, k]
        packed[i, 5] = wp.log2(opacity[i])
        packed[i, 6] = beta[i]
        packed[i, 7] = float(e.r2_max)
        packed[i, 8] = depth[i]
    counts[i] = count


@no_type_check
@wp.kernel(enable_backward=False)
def list_tiles(
    mean2d: wp.array2d(dtype=float), conic: wp.array2d(dtype=float), opacity: wp.array(dtype=float),
    beta: wp.array(dtype=float), depth: wp.array(dtype=float), depth_bits: wp.array(dtype=int),
    width: int, height: int, alpha_min: wp.float64, gaussian: int,
    ends: wp.array(dtype=wp.int64), keys: wp.array(dtype=wp.int64), ids: wp.array(dtype=int),
):  # fmt: skip
    """Tile and depth of each pair, as one number to sort by, and its primitive; primitive i's end at ends[i]."""
    i = wp.tid()
    at = wp.int64(0)
    if i > 0:
        at = ends[i - 1]
    if at < ends[i]:
        e = ellipse_of(i, width, height, alpha_min, gaussian, mean2d, conic, opacity, beta, depth)
        columns = (width + SIDE - 1) // SIDE
        for row in range(e.first_y // SIDE, e.last_y // SIDE + 1):
            first, last = tiles_of_row(e, row)
            for column in range(first, last + 1):
                tile = row * columns + column
                keys[at] = (wp.int64(tile) << wp.int64(32)) | wp.int64(depth_bits[i])
                ids[at] = i
                at += wp.int64(1)


def bin_primitives(p: Primitives2D, height: int, width: int, alpha_min: float, kernel: Kernel) -> Bins:
    """Tile lists on the primitives' device: every tile of which an ellipse may cover a pixel.

    They list a few in ten thousand more than the CPU's, which asks strips of four rows (`raster.cpu.bins.span`).
    The host waits once, for the number of pairs.
    """
    n, device = len(p.depth), p.depth.device
    mean2d, conic, color, opacity, beta, depth = (values.detach().contiguous() for values in p)
    packed, counts = torch.zeros(n, 16, device=device), torch.zeros(n, dtype=torch.int64, device=device)
    size = (width, height, alpha_min, int(kernel == "gaussian"))
    if n:
        launch(count_tiles, (n,), [mean2d, conic, color, opacity, beta, depth, *size, packed, counts])
    ends = counts.cumsum(0)
    pairs = int(ends[-1]) if n else 0
    keys = torch.empty(pairs, dtype=torch.int64, device=device)
    ids = torch.empty(pairs, dtype=torch.int32, device=device)
    if pairs:
        bits = depth.view(torch.int32)  # those of positive floats sort like the floats
        launch(list_tiles, (n,), [mean2d, conic, opacity, beta, depth, bits, *size, ends, keys, ids])
    keys, order = torch.sort(keys, stable=True)
    tiles = ((height + TILE - 1) // TILE) * ((width + TILE - 1) // TILE)
    tile_start = torch.searchsorted(keys, torch.arange(tiles + 1, device=device) << 32).int()
    return Bins(height, width, alpha_min, kernel, packed, tile_start, ids[order])
