"""The loops of the plane sweep, compiled by Numba: cost volume, semi-global smoothing, slanted planes.

Pixels are indices here (center of the first pixel = 0). A pixel x of the reference at inverse depth q = 1 / z lands in
a source at H x + q e, with H = K_s R K_r^-1 and e = K_s t (homogeneous). A plane in space is an affine function of the
pixel in q, so a window on a slanted surface needs only the two slopes of q. Costs are 1 - NCC in 0..1: 1 where a source
does not see the pixel, or where the window holds nothing above the noise. The arithmetic is `pixel_math`'s.

Gray values are kept as integers of `SCALE` per unit: a pixel and its right neighbor share an int32 (`packed`).
"""

import zlib
from pathlib import Path
from typing import Any, cast, no_type_check

import numpy as np
from numba import njit

from swimm3r.sfm.plane_sweep import pixel_math

FLAGS: dict[str, Any] = {"nogil": True, "fastmath": True, "error_model": "numpy"}
kernel = njit(cache=True, **FLAGS)
inlined = cast(Any, njit)(forceinline=True, _nrt=False, **FLAGS)
"""For the parts of a kernel's inner loop; not cached by themselves. Nothing is allocated in them: without that promise
Numba counts references to every array at every call, which costs more than a window's arithmetic."""

SCALE = 32767.0
"""Integers per unit of gray."""

_FAR = 1e9  # a cost that nothing chooses

# Numba's cache looks at the kernel's own file only. The sources of what is inlined enter a kernel's signature through
# this number, the default of an argument nobody passes: editing pixel_math.py recompiles.
SOURCES = zlib.crc32(b"".join(Path(path).read_bytes() for path in (str(pixel_math.__file__), __file__)))


@inlined
@no_type_check
def minimum(a, b):
    """Smaller of two."""
    return a if a < b else b


@inlined
@no_type_check
def maximum(a, b):
    """Larger of two."""
    return a if a > b else b


@inlined
@no_type_check
def select(condition, a, b):
    """a where the condition holds, else b."""
    return a if condition else b


@inlined
@no_type_check
def square_root(x):
    """Square root in the precision of x."""
    return np.sqrt(x)


pixel = pixel_math.make(inlined, minimum, maximum, select, square_root, np.float32)
clamped, _row_times, _ahead, _inside = pixel.clamped, pixel.row_times, pixel.ahead, pixel.inside
_bilinear, _ncc_cost = pixel.bilinear, pixel.ncc_cost
_path_cost, _jump_price, _minimum_between = pixel.path_cost, pixel.jump_price, pixel.minimum_between


@kernel
@no_type_check
def packed(images):
    """Images [s, h, w] as integers; each int32 holds a pixel in its lower half and the next to its right above."""
    count, h, w = images.shape
    out = np.empty((count, h, w), np.int32)
    most = np.float32(SCALE)
    for s in range(count):
        for y in range(h):
            right = np.int32(0)
            for back in range(w):
                x = w - 1 - back
                value = np.int32(np.rint(max(-most, min(most, images[s, y, x] * most))))
                out[s, y, x] = np.int32(right << 16) | (value & np.int32(0xFFFF))
                right = value
    return out


@inlined
@no_type_check
def place(at):
    """An int32 as an index that is not negative: 16 of them fit into one gather, and none counts from the end."""
    return np.uint32(at & np.int32(0x7FFFFFFF))


@inlined
@no_type_check
def unpacked_left(pair):
    """The pixel itself."""
    return np.float32(np.int32(np.int32(pair << np.int32(16)) >> np.int32(16)))


@inlined
@no_type_check
def unpacked_right(pair):
    """The pixel to its right."""
    return np.float32(np.int32(pair >> np.int32(16)))


@kernel
@no_type_check
def _positions(w, most_u, most_v, lens, y, q, at, across, down):
    """Fill the source's pixels, and the fractions beside them, that show a row of the reference at inverse depth q.

    A fraction across of -1 is outside of the source's image.
    """
    X0, Y0, Z0 = lens[1] * y + lens[2], lens[4] * y + lens[5], lens[7] * y + lens[8]
    X0, Y0, Z0 = X0 + q * lens[9], Y0 + q * lens[10], Z0 + q * lens[11]
    Xx, Yx, Zx = lens[0], lens[3], lens[6]
    one = np.float32(1)
    for n in range(at.shape[0]):
        x = np.float32(n)
        X, Y, Z = X0 + Xx * x, Y0 + Yx * x, Z0 + Zx * x
        inverse = one / _ahead(Z)
        u, v = clamped(X * inverse, most_u), clamped(Y * inverse, most_v)
        i, j = np.int32(u), np.int32(v)
        at[n] = np.int32(np.int32(j * np.int32(w)) + i)
        across[n] = select(_inside(X, Y, Z, most_u, most_v), u - np.float32(i), -one)
        down[n] = v - np.float32(j)


@kernel
@no_type_check
def _warp_row(flat, seen, w, at, across, down, warped, visible):
    """One row of the reference as a source shows it at these positions, 0 where it does not."""
    zero, row = np.float32(0), np.int32(w)
    for n in range(at.shape[0]):
        a, b = across[n], down[n]
        upper, lower = flat[place(at[n])], flat[place(np.int32(at[n] + row))]
        value = _bilinear(
            unpacked_left(upper), unpacked_right(upper), unpacked_left(lower), unpacked_right(lower), a, b
        )
        ok = (a >= zero) & seen[place(at[n])]
        warped[n] = select(ok, value, zero)
        visible[n] = ok


@kernel
@no_type_check
def _add_row(columns, reference, warped, sign, radius):
    """Take a row into the sums along columns, or out of them: s, ss, rs."""
    w = warped.shape[0]
    for x in range(w):
        s = warped[x]
        c = np.uint32(x + radius)
        signed = sign * s
        columns[0, c] += signed
        columns[1, c] += signed * s
        columns[2, c] += signed * reference[x]


@kernel
@no_type_check
def _cost_row(columns, sums, radius, rows, mean, variance, noise, visible, cost):
    """Costs of a row's windows from the sums along columns, which have `radius` zeros at either end."""
    w = cost.shape[0]
    sums[:] = 0
    for k in range(2 * radius + 1):
        for x in range(w):
            c = np.uint32(x + k)
            sums[0, x] += columns[0, c]
            sums[1, x] += columns[1, c]
            sums[2, x] += columns[2, c]
    one = np.float32(1)
    for x in range(w):
        wide = np.float32(min(w - 1, x + radius) - max(0, x - radius) + 1)
        share = one / (np.float32(rows) * wide)
        found = _ncc_cost(sums[0, x] * share, sums[1, x] * share, sums[2, x] * share, mean[x], variance[x], noise)
        cost[x] = select(visible[x], found, one)


@kernel
@no_type_check
def _window_moments(reference, radius):
    """Mean and variance of every square window, cut off at the border."""
    h, w = reference.shape
    mean, variance = np.empty((h, w), np.float32), np.empty((h, w), np.float32)
    for y in range(h):
        top, bottom = max(0, y - radius), min(h, y + radius + 1)
        for x in range(w):
            left, right = max(0, x - radius), min(w, x + radius + 1)
            total = square = 0.0
            for j in range(top, bottom):
                for i in range(left, right):
                    total += reference[j, i]
                    square += reference[j, i] * reference[j, i]
            n = (bottom - top) * (right - left)
            mean[y, x] = total / n
            variance[y, x] = max(square / n - (total / n) ** 2, 0.0)
    return mean, variance


@kernel
@no_type_check
def _exchange(low, high):
    """The smaller of either pair of values goes into `low`."""
    for x in range(low.shape[0]):
        a, b = low[x], high[x]
        low[x], high[x] = min(a, b), max(a, b)


@kernel
@no_type_check
def _source_costs(
    reference, flat, seen, lens, q, radius, moments, noise, at, fractions, warped, visible, columns, sums, cost
):  # fmt: skip
    """1 - NCC of every square window in one source if everything stood at inverse depth q."""
    h, w = reference.shape
    most_u, most_v = np.float32(w) - np.float32(1.01), np.float32(h) - np.float32(1.01)
    columns[:] = 0
    for y in range(-radius, h):
        ahead, behind = y + radius, y - radius - 1
        if ahead < h:
            _positions(w, most_u, most_v, lens, np.float32(ahead), q, at, fractions[0], fractions[1])
            _warp_row(flat, seen, w, at, fractions[0], fractions[1], warped[ahead], visible[ahead])
            _add_row(columns, reference[ahead], warped[ahead], np.float32(1), radius)
        if behind >= 0:
            _add_row(columns, reference[behind], warped[behind], np.float32(-1), radius)
        if y >= 0:
            rows = min(h - 1, ahead) - max(0, y - radius) + 1
            _cost_row(columns, sums, radius, rows, moments[0][y], moments[1][y], noise, visible[y], cost[y])


@kernel
@no_type_check
def sweep_costs(reference, flat, seen, lenses, planes, radius, noise, keep, stamp=SOURCES):
    """Cost volume [h, w, planes]: the mean over the `keep` sources that agree best with each plane.

    `flat` [s, h, w] are the sources' packed images, `seen` where a window lies wholly in what they show,
    `lenses` [s, 12] their H and e.
    """
    count = flat.shape[0]
    h, w = reference.shape
    volume = np.empty((h, w, planes.size), np.float32)
    warped, visible = np.empty((h, w), np.float32), np.empty((h, w), np.bool_)
    at, fractions = np.empty(w, np.int32), np.empty((2, w), np.float32)
    columns, sums = np.empty((3, w + 2 * radius), np.float32), np.empty((3, w), np.float32)
    costs = np.empty((count, h, w), np.float32)
    moments = _window_moments(reference, radius)
    share = np.float32(1) / np.float32(keep)
    for d in range(planes.size):
        for s in range(count):
            _source_costs(
                reference, flat[s].ravel(), seen[s].ravel(), lenses[s], np.float32(planes[d]), radius, moments,
                np.float32(noise), at, fractions, warped, visible, columns, sums, costs[s],
            )  # fmt: skip
        for y in range(h):
            for best in range(keep):
                for s in range(best + 1, count):
                    _exchange(costs[best, y], costs[s, y])
            for x in range(w):
                total = np.float32(0)
                for best in range(keep):
                    total += costs[best, y, x]
                volume[y, x, d] = total * share
    return volume


@kernel
@no_type_check
def _along_path(cost, path, least, jump, small, now, total):
    """One pixel's path costs from those of the pixel before, added to `total`; the least of them.

    `path` and `now` have an end of `_FAR` before and behind the planes.
    """
    lowest = np.float32(_FAR)
    for d in range(cost.shape[0]):
        value = _path_cost(cost[d], path[np.uint32(d + 1)], path[d], path[np.uint32(d + 2)], least, jump, small)
        now[np.uint32(d + 1)] = value
        total[d] += value
        lowest = minimum(lowest, value)
    return lowest


@kernel
@no_type_check
def semi_global(volume, guide, small, large, edge, stamp=SOURCES):
    """Costs summed along eight straight paths (Hirschmueller 2008).

    A step of one plane costs `small`, a larger one `large`, less where the guide changes by more than `edge`.
    """
    h, w, planes = volume.shape
    total = np.zeros((h, w, planes), np.float32)
    small, large, edge, zero = np.float32(small), np.float32(large), np.float32(edge), np.float32(0)
    nothing = np.zeros(planes + 2, np.float32)  # before the first pixel of a path
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        before = np.full((w, planes + 2), _FAR, np.float32)  # of the row before, or of this row for dy = 0
        now = np.full((w, planes + 2), _FAR, np.float32)
        least, least_now = np.zeros(w, np.float32), np.zeros(w, np.float32)
        for row in range(h):
            y = row if dy >= 0 else h - 1 - row
            for column in range(w):
                x = column if dx >= 0 else w - 1 - column
                py, px = y - dy, x - dx
                if py < 0 or py >= h or px < 0 or px >= w:
                    least_now[x] = _along_path(volume[y, x], nothing, zero, zero, zero, now[x], total[y, x])
                    continue
                jump = _jump_price(guide[y, x] - guide[py, px], small, large, edge)
                path, floor = (now[px], least_now[px]) if dy == 0 else (before[px], least[px])
                least_now[x] = _along_path(volume[y, x], path, floor, jump, small, now[x], total[y, x])
            before, now = now, before
            least, least_now = least_now, least
    return total


@kernel
@no_type_check
def best_plane(total, planes, stamp=SOURCES):
    """Inverse depth of the cheapest plane, between planes by a parabola; planes are evenly spaced."""
    h, w, count = total.shape
    q = np.empty((h, w), np.float32)
    spacing = np.float32(planes[1] - planes[0])
    for y in range(h):
        for x in range(w):
            d = 0
            for k in range(1, count):
                if total[y, x, k] < total[y, x, d]:
                    d = k
            shift = np.float32(0)
            if 0 < d < count - 1:
                shift = _minimum_between(total[y, x, d - 1], total[y, x, d], total[y, x, d + 1])
            q[y, x] = np.float32(planes[d]) + shift * spacing
    return q


@kernel
@no_type_check
def doubled(q):
    """Inverse depth at twice the size with its slopes along x and y per pixel of the larger grid: [2h, 2w, 3].

    The slope is the smaller of the two one-sided differences of the 3 x 3 median, 0 where they differ in sign, so that
    no slope bridges a depth edge.
    """
    h, w = q.shape
    smooth = q.copy()
    window = np.empty(9, q.dtype)
    for y in range(1, h - 1):
        for x in range(1, w - 1):
            for k in range(9):
                window[k] = q[y + k // 3 - 1, x + k % 3 - 1]
            smooth[y, x] = np.sort(window)[4]
    out = np.empty((2 * h, 2 * w, 3), q.dtype)
    for y in range(h):
        for x in range(w):
            for axis in range(2):
                j0, i0 = (y, max(x - 1, 0)) if axis == 0 else (max(y - 1, 0), x)
                j1, i1 = (y, min(x + 1, w - 1)) if axis == 0 else (min(y + 1, h - 1), x)
                a, b = smooth[y, x] - smooth[j0, i0], smooth[j1, i1] - smooth[y, x]
                slope = 0.0 if a * b <= 0 else (a if abs(a) < abs(b) else b)
                out[2 * y : 2 * y + 2, 2 * x : 2 * x + 2, 1 + axis] = 0.5 * slope
            for b in range(2):
                for a in range(2):
                    j, i = 2 * y + b, 2 * x + a
                    out[j, i, 0] = smooth[y, x] + (a - 0.5) * out[j, i, 1] + (b - 0.5) * out[j, i, 2]
    return out
