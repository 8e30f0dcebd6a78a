"""Slanted-plane refinement of inverse depth, compiled by Numba (Bleyer et al. 2011; conventions as in `kernels`).

A pixel's plane is (q, dq/dx, dq/dy). Each round a pixel compares eight candidates: its own plane, those of four
neighbors extended to it, its own moved nearer and farther, and its own with the mean slopes of its surroundings.
"""

from typing import no_type_check

import numpy as np

from swimm3r.sfm.plane_sweep.kernels import kernel

OWN, FIRST_NEIGHBOR, NEARER, FARTHER, SLOPES, CANDIDATES = 0, 1, 5, 6, 7, 8
_SAME = 0.05  # source pixels: a candidate that differs less from the own plane is not tried
_ROUGHEST = 2.0  # source pixels: most that one neighbor's disagreement counts
_MIN_SOURCES = 2  # further sources count only where they see the pixel


@kernel
@no_type_check
def _patch_cost(sources, n, x, y, q, gx, gy, window):
    """1 - weighted NCC of one window between the reference and source n, on a plane through the pixel."""
    flat, seen, shape, H, e = sources
    offsets, patch, weights, mean, variance, noise = window
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
def _bilateral_window(reference, guide, offsets, noise, edge, y, x, patch, weights):
    """Fill the window's values and weights; its mean, its variance, and whether its center's likes have texture."""
    total = mean = square = 0.0
    for k in range(offsets.shape[0]):
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
    total = inner = square = 0.0  # pixels like the center must have texture of their own, not only a border
    for k in range(offsets.shape[0]):
        likeness = weights[k] * weights[k]
        total += likeness
        inner += likeness * patch[k]
        square += likeness * patch[k] * patch[k]
    return mean, variance, square * total - inner * inner >= noise * total * total


@kernel
@no_type_check
def _best_sources(sources, x, y, q, gx, gy, window, first, left, chosen):
    """Fill `first`, every source's cost on the own plane, and `chosen`, the sources that count.

    Returns how many are chosen, and the most source pixels that a unit of q moves the pixel by.
    """
    _, _, _, H, e = sources
    count = first.shape[0]
    for s in range(count):
        first[s] = _patch_cost(sources, s, x, y, q, gx, gy, window)
        left[s] = first[s]
    speed, kept = 0.0, 0
    for n in range(chosen.shape[0]):
        best = 0
        for s in range(1, count):
            if left[s] < left[best]:
                best = s
        if n >= _MIN_SOURCES and left[best] >= 1:
            break
        left[best] = 1e9
        chosen[n] = best
        kept = n + 1
        X = H[best, 0, 0] * x + H[best, 0, 1] * y + H[best, 0, 2] + q * e[best, 0]
        Y = H[best, 1, 0] * x + H[best, 1, 1] * y + H[best, 1, 2] + q * e[best, 1]
        Z = H[best, 2, 0] * x + H[best, 2, 1] * y + H[best, 2, 2] + q * e[best, 2]
        speed = max(speed, np.hypot(e[best, 0] * Z - X * e[best, 2], e[best, 1] * Z - Y * e[best, 2]) / (Z * Z))
    return kept, speed


@kernel
@no_type_check
def _extended(surface, y, x, dy, dx):
    """q at pixel (y, x) of the plane of pixel (y + dy, x + dx)."""
    return surface[y + dy, x + dx, 0] - surface[y + dy, x + dx, 1] * dx - surface[y + dy, x + dx, 2] * dy


@kernel
@no_type_check
def _propose(surface, y, x, reach, move, tries, beside):
    """Fill the candidate planes, and q of the four nearest pixels' planes at this one."""
    for n in (OWN, NEARER, FARTHER, SLOPES):
        for k in range(3):
            tries[n, k] = surface[y, x, k]
    for n in range(4):
        dy, dx = (n // 2) * (2 * n - 5), (1 - n // 2) * (2 * n - 1)  # (0, -1), (0, 1), (-1, 0), (1, 0)
        beside[n] = _extended(surface, y, x, dy, dx)
        dy, dx = dy * reach, dx * reach
        tries[FIRST_NEIGHBOR + n, 0] = _extended(surface, y, x, dy, dx)
        for k in range(1, 3):
            tries[FIRST_NEIGHBOR + n, k] = surface[y + dy, x + dx, k]
    tries[NEARER, 0] += move
    tries[FARTHER, 0] -= move
    tries[SLOPES, 1] = 0.25 * (surface[y, x + 2, 0] - surface[y, x - 2, 0])
    tries[SLOPES, 2] = 0.25 * (surface[y + 2, x, 0] - surface[y - 2, x, 0])


@kernel
@no_type_check
def _is_tried(tries, n, q, margin, speed, reach):
    """Return whether a candidate lies ahead and differs from the own plane; only that and its moves are judged at reach
    0."""
    if n == OWN:
        return tries[n, 0] > 0
    apart = abs(tries[n, 0] - q) + margin * (abs(tries[n, 1] - tries[OWN, 1]) + abs(tries[n, 2] - tries[OWN, 2]))
    return tries[n, 0] > 0 and apart * speed >= _SAME and (reach > 0 or n in (NEARER, FARTHER))


@kernel
@no_type_check
def _roughness(beside, q, speed):
    """Disagreement with the four nearest pixels' planes, source pixels."""
    total = 0.0
    for k in range(4):
        total += min(abs(beside[k] - q) * speed, _ROUGHEST)
    return total


@kernel
@no_type_check
def _photometric_cost(sources, x, y, q, gx, gy, window, chosen, kept, limit):
    """Mean cost over the chosen sources; broken off beyond `limit`."""
    total = 0.0
    for m in range(kept):
        total += _patch_cost(sources, chosen[m], x, y, q, gx, gy, window) / kept
        if total >= limit:
            break
    return total


@kernel
@no_type_check
def _best_candidate(sources, x, y, window, first, chosen, kept, speed, tries, beside, margin, smooth, reach, move):
    """The cheapest candidate, its photometric cost, and how much leaving the own plane's depth raises that.

    Where the own plane is a minimum along depth, it is moved to the parabola's before it can be returned.
    """
    lowest, pick, middle, peak = 1e9, OWN, 1.0, 0.0
    center, side, q = 1.0, 1.0, tries[OWN, 0]
    for n in range(CANDIDATES):
        if not _is_tried(tries, n, q, margin, speed, reach):
            continue
        penalty = 0.25 * smooth * _roughness(beside, tries[n, 0], speed)
        if n == OWN:
            cost = 0.0
            for m in range(kept):
                cost += first[chosen[m]] / kept
        else:
            limit = 1e9 if n in (NEARER, FARTHER) else lowest - penalty
            cost = _photometric_cost(sources, x, y, tries[n, 0], tries[n, 1], tries[n, 2], window, chosen, kept, limit)
        if cost + penalty < lowest and (n == OWN or reach > 0):
            lowest, pick, middle = cost + penalty, n, cost
        if n == OWN:
            center = cost
        elif n == NEARER:
            side = cost
        elif n == FARTHER:
            peak = min(side, cost) - center
            if peak > 0 and reach > 0:
                tries[OWN, 0] += 0.5 * move * (cost - side) / (side + cost - 2 * center)
    return pick, middle, peak


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
    new = surface.copy()
    cost = np.ones((h, w), np.float32)
    peak = np.zeros((h, w), np.float32)
    noise = np.float32(noise)
    views = (sources.ravel(), seen.ravel(), (h, w), H, e)
    patch, weights = np.empty(offsets.shape[0], np.float32), np.empty(offsets.shape[0], np.float32)
    first, left, chosen = np.empty(sources.shape[0]), np.empty(sources.shape[0]), np.empty(keep, np.int64)
    tries, beside = np.empty((CANDIDATES, 3)), np.empty(4)
    margin = int(np.abs(offsets).max())
    for y in range(margin, h - margin):
        for x in range(margin, w - margin):
            if not usable[y, x]:
                continue
            mean, variance, textured = _bilateral_window(reference, guide, offsets, noise, edge, y, x, patch, weights)
            if not textured:
                continue
            window = (offsets, patch, weights, mean, variance, noise)
            q, gx, gy = surface[y, x, 0], surface[y, x, 1], surface[y, x, 2]
            kept, speed = _best_sources(views, x, y, q, gx, gy, window, first, left, chosen)
            move = step / max(speed, 1e-12)
            _propose(surface, y, x, reach, move, tries, beside)
            pick, cost[y, x], peak[y, x] = _best_candidate(
                views, x, y, window, first, chosen, kept, speed, tries, beside, margin, smooth, reach, move
            )
            for k in range(3):
                new[y, x, k] = tries[pick, k]
    return new, cost, peak
