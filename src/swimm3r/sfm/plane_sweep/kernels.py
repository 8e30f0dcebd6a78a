"""The loops of the plane sweep, compiled by Numba: cost volume, semi-global smoothing, slanted refinement.

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


@kernel
@no_type_check
def _patch_cost(flat, seen, shape, H, e, n, x, y, q, gx, gy, offsets, patch, weights, mean, variance, noise):
    """1 - weighted NCC of one window between the reference and source n, on a plane through the pixel."""
    h, w = shape
    X0 = np.float32(H[n, 0, 0] * x + H[n, 0, 1] * y + H[n, 0, 2] + q * e[n, 0])
    Y0 = np.float32(H[n, 1, 0] * x + H[n, 1, 1] * y + H[n, 1, 2] + q * e[n, 1])
    Z0 = np.float32(H[n, 2, 0] * x + H[n, 2, 1] * y + H[n, 2, 2] + q * e[n, 2])
    Xx, Xy = np.float32(H[n, 0, 0] + gx * e[n, 0]), np.float32(H[n, 0, 1] + gy * e[n, 0])
    Yx, Yy = np.float32(H[n, 1, 0] + gx * e[n, 1]), np.float32(H[n, 1, 1] + gy * e[n, 1])
    Zx, Zy = np.float32(H[n, 2, 0] + gx * e[n, 2]), np.float32(H[n, 2, 1] + gy * e[n, 2])
    one, right, low = np.float32(1), np.float32(w - 1), np.float32(h - 1)
    far = offsets[offsets.shape[0] - 1, 0]
    for k in range(4):  # the window is convex: its corners tell
        dx, dy = far if k % 2 else -far, far if k // 2 else -far
        Z = Z0 + dx * Zx + dy * Zy
        X, Y = X0 + dx * Xx + dy * Xy, Y0 + dx * Yx + dy * Yy
        if not (Z > 0 and 0 <= X < right * Z and 0 <= Y < low * Z):
            return np.float32(1)
    base = np.int32(n * h * w)
    row = np.int32(w)
    if not seen[np.uint32(base + np.int32(Y0 / Z0) * row + np.int32(X0 / Z0))]:
        return np.float32(1)
    s_sum = ss_sum = rs_sum = np.float32(0)
    for k in range(offsets.shape[0]):
        dx, dy = offsets[k, 0], offsets[k, 1]
        inverse = one / (Z0 + dx * Zx + dy * Zy)
        u, v = (X0 + dx * Xx + dy * Xy) * inverse, (Y0 + dx * Yx + dy * Yy) * inverse
        i, j = np.int32(u), np.int32(v)
        a, b = u - np.float32(i), v - np.float32(j)
        at = base + j * row + i
        top, right_top = flat[np.uint32(at)], flat[np.uint32(at + 1)]
        bottom, right_bottom = flat[np.uint32(at + row)], flat[np.uint32(at + row + 1)]
        upper = top + a * (right_top - top)
        lower = bottom + a * (right_bottom - bottom)
        s = upper + b * (lower - upper)
        weighted = weights[k] * s
        s_sum += weighted
        ss_sum += weighted * s
        rs_sum += weighted * patch[k]
    covariance = rs_sum - s_sum * mean
    spread = max(ss_sum - s_sum * s_sum, np.float32(0)) + noise
    return min(one, one - covariance / np.sqrt((variance + noise) * spread))


@kernel
@no_type_check
def _extended(surface, y, x, j, i):
    """The plane of pixel (j, i) at pixel (y, x)."""
    return surface[j, i, 0] + surface[j, i, 1] * (x - i) + surface[j, i, 2] * (y - j)


@kernel
@no_type_check
def refine(reference, guide, usable, sources, seen, H, e, surface, offsets, noise, edge, keep, smooth, step, reach):
    """One round of slanted-plane refinement: every pixel tries its neighbors' planes and small moves of its own.

    `surface` [h, w, 3] holds q and its slopes along x and y. Windows weigh pixels by likeness to their center
    (bilateral), which keeps depth edges on image edges. `step` is the trial move in source pixels, `reach` the
    distance of the neighbors asked (0: nothing moves, the surface is only judged), `smooth` the price of one source
    pixel of disagreement with the four nearest. All pixels read the state of the round before, so order does not
    matter. Returns the new surface, its cost (1 - NCC), and `peak`: how much the cost of the old one rises by `step`.
    """
    h, w = reference.shape
    count, samples = sources.shape[0], offsets.shape[0]
    new = surface.copy()
    cost = np.ones((h, w), np.float32)
    peak = np.zeros((h, w), np.float32)
    noise = np.float32(noise)
    flat, flat_seen = sources.ravel(), seen.ravel()
    patch, weights = np.empty(samples, np.float32), np.empty(samples, np.float32)
    costs, chosen, first = np.empty(count), np.empty(keep, np.int64), np.empty(count)
    tries, beside = np.empty((8, 3)), np.empty(4)
    margin = int(np.abs(offsets).max())
    for y in range(margin, h - margin):
        for x in range(margin, w - margin):
            if not usable[y, x]:
                continue
            total = mean = square = 0.0
            for k in range(samples):
                i, j = x + int(offsets[k, 0]), y + int(offsets[k, 1])
                likeness = (guide[j, i] - guide[y, x]) / edge
                weights[k] = np.exp(-0.5 * likeness * likeness)
                patch[k] = reference[j, i]
                total += weights[k]
                mean += weights[k] * patch[k]
                square += weights[k] * patch[k] * patch[k]
            weights /= total
            mean /= total
            variance = max(square / total - mean * mean, 0.0)
            total = inner = square = 0.0  # what resembles the center must have texture of its own, not only a border
            for k in range(samples):
                likeness = weights[k] * weights[k]
                total += likeness
                inner += likeness * patch[k]
                square += likeness * patch[k] * patch[k]
            if square * total - inner * inner < noise * total * total:
                continue
            q, gx, gy = surface[y, x, 0], surface[y, x, 1], surface[y, x, 2]
            for s in range(count):
                first[s] = _patch_cost(flat, flat_seen, (h, w), H, e, s, x, y, q, gx, gy,
                                       offsets, patch, weights, mean, variance, noise)  # fmt: skip
                costs[s] = first[s]
            speed = 0.0  # source pixels per unit of q
            kept = 0
            for n in range(keep):
                best = 0
                for s in range(1, count):
                    if costs[s] < costs[best]:
                        best = s
                if n >= 2 and costs[best] >= 1:
                    break  # not seen from there; two views are enough
                costs[best] = 1e9
                chosen[n] = best
                kept = n + 1
                X = H[best, 0, 0] * x + H[best, 0, 1] * y + H[best, 0, 2] + q * e[best, 0]
                Y = H[best, 1, 0] * x + H[best, 1, 1] * y + H[best, 1, 2] + q * e[best, 1]
                Z = H[best, 2, 0] * x + H[best, 2, 1] * y + H[best, 2, 2] + q * e[best, 2]
                speed = max(speed, np.hypot(e[best, 0] * Z - X * e[best, 2], e[best, 1] * Z - Y * e[best, 2]) / (Z * Z))
            move = step / max(speed, 1e-12)
            for n in (0, 5, 6, 7):
                tries[n, 0], tries[n, 1], tries[n, 2] = q, gx, gy
            for n in range(4):
                dy, dx = (n // 2) * (2 * n - 5), (1 - n // 2) * (2 * n - 1)  # (0, -1), (0, 1), (-1, 0), (1, 0)
                beside[n] = (
                    surface[y + dy, x + dx, 0] - surface[y + dy, x + dx, 1] * dx - surface[y + dy, x + dx, 2] * dy
                )
                dy, dx = dy * reach, dx * reach
                tries[1 + n, 0] = (
                    surface[y + dy, x + dx, 0] - surface[y + dy, x + dx, 1] * dx - surface[y + dy, x + dx, 2] * dy
                )
                tries[1 + n, 1], tries[1 + n, 2] = surface[y + dy, x + dx, 1], surface[y + dy, x + dx, 2]
            tries[5, 0] += move
            tries[6, 0] -= move
            tries[7, 1] = 0.25 * (surface[y, x + 2, 0] - surface[y, x - 2, 0])
            tries[7, 2] = 0.25 * (surface[y + 2, x, 0] - surface[y - 2, x, 0])
            lowest, pick, center, side, middle = 1e9, 0, 1.0, 1.0, 1.0
            for n in range(8):
                apart = abs(tries[n, 0] - q) + margin * (abs(tries[n, 1] - gx) + abs(tries[n, 2] - gy))
                if tries[n, 0] <= 0 or (n > 0 and apart * speed < 0.05) or (reach == 0 and n not in (0, 5, 6)):
                    continue
                rough = 0.0
                for k in range(4):
                    rough += min(abs(beside[k] - tries[n, 0]) * speed, 2.0)
                photometric = 0.0
                for m in range(kept):
                    s = chosen[m]
                    single = first[s]
                    if n > 0:
                        single = _patch_cost(flat, flat_seen, (h, w), H, e, s, x, y, tries[n, 0], tries[n, 1],
                                             tries[n, 2], offsets, patch, weights, mean, variance, noise)  # fmt: skip
                    photometric += single / kept
                    if n not in (5, 6) and photometric + 0.25 * smooth * rough >= lowest:
                        break
                if photometric + 0.25 * smooth * rough < lowest and (n == 0 or reach > 0):
                    lowest, pick, middle = photometric + 0.25 * smooth * rough, n, photometric
                if n == 0:
                    center = photometric
                elif n == 5:
                    side = photometric
                elif n == 6:
                    peak[y, x] = min(side, photometric) - center
                    if peak[y, x] > 0 and reach > 0:  # the own plane is a minimum: move to the parabola's
                        tries[0, 0] += 0.5 * move * (photometric - side) / (side + photometric - 2 * center)
            for k in range(3):
                new[y, x, k] = tries[pick, k]
            cost[y, x] = middle
    return new, cost, peak
