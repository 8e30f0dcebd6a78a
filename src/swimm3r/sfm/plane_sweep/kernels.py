"""The loops of the plane sweep, compiled by Numba: cost volume, semi-global smoothing, slanted planes.

Pixels are indices here (center of the first pixel = 0). A pixel x of the reference at inverse depth q = 1 / z lands in
a source at H x + q e, with H = K_s R K_r^-1 and e = K_s t (homogeneous). A plane in space is an affine function of the
pixel in q, so a window on a slanted surface needs only the two slopes of q. Costs are 1 - NCC in 0..1: 1 where a source
does not see the pixel, or where the window holds nothing above the noise.
"""

from typing import no_type_check

import numpy as np
from numba import njit

kernel = njit(cache=True, nogil=True, fastmath=True, error_model="numpy")


@kernel
@no_type_check
def _mean_of_best(costs: np.ndarray, count: int, keep: int) -> float:
    """The mean of the `keep` smallest of the first `count` values, which it reorders."""
    total = 0.0
    for i in range(keep):
        best = i
        for j in range(i + 1, count):
            if costs[j] < costs[best]:
                best = j
        costs[i], costs[best] = costs[best], costs[i]
        total += costs[i]
    return total / keep


@kernel
@no_type_check
def _warp(source, seen, H, e, q, warped, inside):
    """One source as the reference would see it if everything stood at inverse depth q."""
    h, w = warped.shape
    for y in range(h):
        X, Y, Z = H[0, 1] * y + H[0, 2] + q * e[0], H[1, 1] * y + H[1, 2] + q * e[1], H[2, 1] * y + H[2, 2] + q * e[2]
        for x in range(w):
            warped[y, x] = 0.0
            inside[y, x] = False
            zz = Z + H[2, 0] * x
            if zz <= 1e-9:
                continue
            u, v = (X + H[0, 0] * x) / zz, (Y + H[1, 0] * x) / zz
            if u < 0 or v < 0 or u >= w - 1 or v >= h - 1:
                continue
            i, j = int(u), int(v)
            if not seen[j, i]:
                continue
            a, b = np.float32(u - i), np.float32(v - j)
            top = source[j, i] + a * (source[j, i + 1] - source[j, i])
            bottom = source[j + 1, i] + a * (source[j + 1, i + 1] - source[j + 1, i])
            warped[y, x] = top + b * (bottom - top)
            inside[y, x] = True


@kernel
@no_type_check
def _window_costs(reference, warped, inside, radius, noise, cost):
    """1 - NCC of every square window by running sums: columns first, then along the row."""
    h, w = reference.shape
    columns = np.zeros((5, w), np.float64)  # r, s, rr, ss, rs
    for y in range(-radius, h):
        for edge, sign in ((y + radius, 1.0), (y - radius - 1, -1.0)):
            if 0 <= edge < h:
                for x in range(w):
                    r, s = sign * reference[edge, x], warped[edge, x]
                    columns[0, x] += r
                    columns[1, x] += sign * s
                    columns[2, x] += r * reference[edge, x]
                    columns[3, x] += sign * s * s
                    columns[4, x] += r * s
        if y < 0:
            continue
        rows = min(h - 1, y + radius) - max(0, y - radius) + 1
        r = s = rr = ss = rs = 0.0
        for x in range(-radius, w):
            if x + radius < w:
                c = x + radius
                r, s, rr = r + columns[0, c], s + columns[1, c], rr + columns[2, c]
                ss, rs = ss + columns[3, c], rs + columns[4, c]
            if x - radius - 1 >= 0:
                c = x - radius - 1
                r, s, rr = r - columns[0, c], s - columns[1, c], rr - columns[2, c]
                ss, rs = ss - columns[3, c], rs - columns[4, c]
            if x < 0:
                continue
            cost[y, x] = 1.0
            if inside[y, x]:
                n = rows * (min(w - 1, x + radius) - max(0, x - radius) + 1)
                covariance = rs / n - r * s / (n * n)
                variances = (max(rr / n - r * r / (n * n), 0.0) + noise) * (max(ss / n - s * s / (n * n), 0.0) + noise)
                cost[y, x] = min(1.0, 1.0 - covariance / np.sqrt(variances))


@kernel
@no_type_check
def sweep_costs(reference, sources, seen, H, e, planes, radius, noise, keep):
    """Cost volume [h, w, planes]: the mean over the `keep` sources that agree best with each plane."""
    count = sources.shape[0]
    h, w = reference.shape
    volume = np.empty((h, w, planes.size), np.float32)
    warped = np.empty((h, w), np.float32)
    inside = np.empty((h, w), np.bool_)
    costs = np.empty((count, h, w), np.float32)
    column = np.empty(count, np.float32)
    for d in range(planes.size):
        for s in range(count):
            _warp(sources[s], seen[s], H[s], e[s], planes[d], warped, inside)
            _window_costs(reference, warped, inside, radius, noise, costs[s])
        for y in range(h):
            for x in range(w):
                for s in range(count):
                    column[s] = costs[s, y, x]
                volume[y, x, d] = _mean_of_best(column, count, keep)
    return volume


@kernel
@no_type_check
def semi_global(volume, guide, small, large, edge):
    """Costs summed along eight straight paths (Hirschmueller 2008).

    A step of one plane costs `small`, a larger one `large`, less where the guide changes by more than `edge`.
    """
    h, w, planes = volume.shape
    total = np.zeros((h, w, planes), np.float32)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        before = np.zeros((w, planes), np.float32)  # path costs of the row before, or of this row for dy = 0
        now = np.zeros((w, planes), np.float32)
        least = np.zeros(w, np.float32)
        least_now = np.zeros(w, np.float32)
        for row in range(h):
            y = row if dy >= 0 else h - 1 - row
            for column in range(w):
                x = column if dx >= 0 else w - 1 - column
                py, px = y - dy, x - dx
                lowest = np.float32(1e9)
                if py < 0 or py >= h or px < 0 or px >= w:
                    for d in range(planes):
                        now[x, d] = volume[y, x, d]
                        lowest = min(lowest, now[x, d])
                else:
                    path, floor = (now[px], least_now[px]) if dy == 0 else (before[px], least[px])
                    jump = floor + max(small, large / (1.0 + abs(guide[y, x] - guide[py, px]) / edge))
                    for d in range(planes):
                        best = min(path[d], jump)
                        if d > 0:
                            best = min(best, path[d - 1] + small)
                        if d + 1 < planes:
                            best = min(best, path[d + 1] + small)
                        now[x, d] = volume[y, x, d] + best - floor
                        lowest = min(lowest, now[x, d])
                least_now[x] = lowest
                for d in range(planes):
                    total[y, x, d] += now[x, d]
            before, now = now, before
            least, least_now = least_now, least
    return total


@kernel
@no_type_check
def best_plane(total, planes):
    """Inverse depth of the cheapest plane, between planes by a parabola; planes are evenly spaced."""
    h, w, count = total.shape
    q = np.empty((h, w), np.float32)
    spacing = planes[1] - planes[0]
    for y in range(h):
        for x in range(w):
            d = 0
            for k in range(1, count):
                if total[y, x, k] < total[y, x, d]:
                    d = k
            shift = 0.0
            if 0 < d < count - 1:
                left, middle, right = total[y, x, d - 1], total[y, x, d], total[y, x, d + 1]
                bend = left - 2 * middle + right
                if bend > 1e-9:
                    shift = 0.5 * (left - right) / bend
            q[y, x] = planes[d] + shift * spacing
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
