"""Slanted-plane refinement of inverse depth, compiled by Numba (Bleyer et al. 2011; conventions as in `kernels`).

A pixel's plane is (q, dq/dx, dq/dy). Each round a pixel compares eight candidates: its own plane, those of four
neighbors extended to it, its own moved nearer and farther, and its own with the mean slopes of its surroundings.

Nearly all of the time goes into `_patch_cost`. Its loop stays vectorized by these means: 16 samples at a time and a
known count; float32 throughout; two pixels in one int32 (`kernels.packed`), so that a sample reads two values and not
four; positions clamped to the image instead of tested; no store inside.
"""

from typing import no_type_check

import numpy as np

from swimm3r.sfm.plane_sweep.kernels import (
    SOURCES,
    clamped,
    inlined,
    kernel,
    pixel,
    place,
    unpacked_left,
    unpacked_right,
)

OWN, FIRST_NEIGHBOR, NEARER, FARTHER, SLOPES, CANDIDATES = 0, 1, 5, 6, 7, 8
LANES = 16  # samples of a window at a time
_MIN_SOURCES = 2  # further sources count only where they see the pixel
_UNSEEN = np.float32(1)  # the cost where a source does not see the pixel
_NEVER = np.float32(1e9)

_inside, _row_times, _ahead, _bilinear = pixel.inside, pixel.row_times, pixel.ahead, pixel.bilinear
_ncc_cost, _likeness, _pixels_per_q = pixel.ncc_cost, pixel.likeness, pixel.pixels_per_q
_extended, _differs, _disagreement = pixel.extended, pixel.differs, pixel.disagreement
_minimum_between, _mean_slope = pixel.minimum_between, pixel.mean_slope


@no_type_check
def window(offsets: np.ndarray) -> np.ndarray:
    """Offsets [n, 2] as rows x, y, used (1 or 0), filled up to whole vectors with copies of the center: [3, m]."""
    n = len(offsets)
    rows = np.zeros((3, -(-n // LANES) * LANES), np.float32)
    rows[:2, :n], rows[2, :n] = offsets.T, 1
    return rows


@inlined
@no_type_check
def _at_infinity(lenses, y, x, bases):
    """Fill the homogeneous points of every source on which the pixel lands at q = 0."""
    for s in range(bases.shape[0]):
        for k in range(3):
            a, b, c = lenses[s, 3 * k], lenses[s, 3 * k + 1], lenses[s, 3 * k + 2]
            bases[s, k] = _row_times(a, b, c, np.float32(x), np.float32(y))


@inlined
@no_type_check
def _patch_cost(sources, n, bases, q, gx, gy, view):
    """1 - weighted NCC of one window between the reference and source n, on a plane through the pixel."""
    flat, seen, lenses, h, w = sources
    offsets, patch, weights, mean, variance, noise = view
    most_u, most_v = np.float32(w) - np.float32(1.01), np.float32(h) - np.float32(1.01)  # the next pixel is read, too
    start, row = np.int32(n * h * w), np.int32(w)
    ex, ey, ez = lenses[n, 9], lenses[n, 10], lenses[n, 11]
    X0, Y0, Z0 = bases[n, 0] + q * ex, bases[n, 1] + q * ey, bases[n, 2] + q * ez
    if not _inside(X0, Y0, Z0, most_u, most_v):
        return _UNSEEN
    if not seen[place(np.int32(start + np.int32(np.int32(Y0 / Z0) * row) + np.int32(X0 / Z0)))]:
        return _UNSEEN
    Xx, Yx, Zx = lenses[n, 0] + gx * ex, lenses[n, 3] + gx * ey, lenses[n, 6] + gx * ez
    Xy, Yy, Zy = lenses[n, 1] + gy * ex, lenses[n, 4] + gy * ey, lenses[n, 7] + gy * ez
    s = ss = rs = np.float32(0)
    for block in range(offsets.shape[1] // LANES):
        for lane in range(LANES):
            k = np.uint32(block * LANES + lane)
            dx, dy = offsets[0, k], offsets[1, k]
            inverse = np.float32(1) / _ahead(_row_times(Zx, Zy, Z0, dx, dy))
            u = clamped(_row_times(Xx, Xy, X0, dx, dy) * inverse, most_u)
            v = clamped(_row_times(Yx, Yy, Y0, dx, dy) * inverse, most_v)
            i, j = np.int32(u), np.int32(v)
            at = np.int32(start + np.int32(np.int32(j * row) + i))
            upper, lower = flat[place(at)], flat[place(np.int32(at + row))]
            value = _bilinear(
                unpacked_left(upper), unpacked_right(upper), unpacked_left(lower), unpacked_right(lower),
                u - np.float32(i), v - np.float32(j),
            )  # fmt: skip
            weighted = weights[k] * value
            s += weighted
            ss += weighted * value
            rs += weighted * patch[k]
    return _ncc_cost(s, ss, rs, mean, variance, noise)


@inlined
@no_type_check
def _bilateral_window(reference, guide, offsets, noise, edge, y, x, patch, weights):
    """Fill the window's values and weights; its mean, its variance, and whether its center's likes have texture."""
    zero = np.float32(0)
    total, mean, square, center = zero, zero, zero, guide[y, x]
    for k in range(offsets.shape[1]):
        j, i = np.uint32(y + np.int32(offsets[1, k])), np.uint32(x + np.int32(offsets[0, k]))
        weight = _likeness(guide[j, i] - center, edge) * offsets[2, k]
        value = reference[j, i]
        weights[k] = weight
        patch[k] = value
        total += weight
        mean += weight * value
        square += weight * value * value
    share = np.float32(1) / total
    all_alike = inner = inner_square = zero  # pixels like the center must have texture of their own, not only a border
    for k in range(offsets.shape[1]):
        likeness = weights[k] * weights[k]
        all_alike += likeness
        inner += likeness * patch[k]
        inner_square += likeness * patch[k] * patch[k]
        weights[k] *= share
    mean *= share
    variance = max(square * share - mean * mean, zero)
    return mean, variance, inner_square * all_alike - inner * inner >= noise * all_alike * all_alike


@inlined
@no_type_check
def _choose(cost, left, chosen):
    """Fill `chosen` with the sources of the least costs, those beyond the second only where they see the pixel.

    Returns how many and their mean cost.
    """
    count, kept, total = cost.shape[0], 0, np.float32(0)
    for s in range(count):
        left[s] = cost[s]
    for n in range(chosen.shape[0]):
        best = 0
        for s in range(1, count):
            if left[s] < left[best]:
                best = s
        if n >= _MIN_SOURCES and left[best] >= _UNSEEN:
            break
        total += left[best]
        left[best] = _NEVER
        chosen[n] = best
        kept = n + 1
    return kept, total / np.float32(kept)


@inlined
@no_type_check
def _propose(surface, y, x, reach, move, tries, beside):
    """Fill the candidate planes, and q of the four nearest pixels' planes at this one."""
    for n in (OWN, NEARER, FARTHER, SLOPES):
        for k in range(3):
            tries[n, k] = surface[y, x, k]
    for n in range(4):
        dy, dx = (n // 2) * (2 * n - 5), (1 - n // 2) * (2 * n - 1)  # (0, -1), (0, 1), (-1, 0), (1, 0)
        j, i = y + dy, x + dx
        beside[n] = _extended(surface[j, i, 0], surface[j, i, 1], surface[j, i, 2], np.float32(-dx), np.float32(-dy))
        dy, dx = dy * reach, dx * reach
        j, i = y + dy, x + dx
        q = _extended(surface[j, i, 0], surface[j, i, 1], surface[j, i, 2], np.float32(-dx), np.float32(-dy))
        tries[FIRST_NEIGHBOR + n, 0] = q
        for k in range(1, 3):
            tries[FIRST_NEIGHBOR + n, k] = surface[j, i, k]
    tries[NEARER, 0] += move
    tries[FARTHER, 0] -= move
    tries[SLOPES, 1] = _mean_slope(surface[y, x - 2, 0], surface[y, x + 2, 0])
    tries[SLOPES, 2] = _mean_slope(surface[y - 2, x, 0], surface[y + 2, x, 0])


@inlined
@no_type_check
def _every_source(sources, bases, q, gx, gy, view, first):
    """Fill every source's cost on the own plane."""
    for s in range(first.shape[0]):
        first[s] = _patch_cost(sources, s, bases, q, gx, gy, view)


@inlined
@no_type_check
def _fastest(lenses, bases, q, chosen, kept):
    """The most source pixels that a unit of q moves the pixel by."""
    speed = np.float32(1e-12)
    for m in range(kept):
        s = chosen[m]
        ex, ey, ez = lenses[s, 9], lenses[s, 10], lenses[s, 11]
        X, Y, Z = bases[s, 0] + q * ex, bases[s, 1] + q * ey, bases[s, 2] + q * ez
        speed = max(speed, _pixels_per_q(X, Y, Z, ex, ey, ez))
    return speed


@inlined
@no_type_check
def _roughness(beside, q, speed):
    """Disagreement with the four nearest pixels' planes, source pixels."""
    total = np.float32(0)
    for k in range(4):
        total += _disagreement(beside[k], q, speed)
    return total


@inlined
@no_type_check
def _is_tried(tries, n, across, speed, reach):
    """Return whether a candidate is worth a look; only the own plane's moves are judged at reach 0."""
    apart = _differs(tries[n, 0], tries[n, 1], tries[n, 2], tries[OWN, 0], tries[OWN, 1], tries[OWN, 2], across, speed)
    return apart and (reach > 0 or n in (NEARER, FARTHER))


@inlined
@no_type_check
def _best_candidate(sources, bases, view, chosen, kept, speed, tries, beside, center, across, price, reach, move):
    """The cheapest candidate, its photometric cost, and how much leaving the own plane's depth raises that.

    Where the own plane is a minimum along depth, it is moved to the parabola's before it is returned.
    """
    share = np.float32(1) / np.float32(kept)
    pick, lowest, middle, peak, side, moved = OWN, _NEVER, _UNSEEN, np.float32(0), _UNSEEN, tries[OWN, 0]
    if moved > 0:
        lowest, middle = center + price * _roughness(beside, moved, speed), center
    for n in range(FIRST_NEIGHBOR, CANDIDATES):
        if not _is_tried(tries, n, across, speed, reach):
            continue
        penalty = price * _roughness(beside, tries[n, 0], speed)
        limit = _NEVER if n in (NEARER, FARTHER) else lowest - penalty
        cost = np.float32(0)
        for m in range(kept):
            cost += share * _patch_cost(sources, chosen[m], bases, tries[n, 0], tries[n, 1], tries[n, 2], view)
            if cost >= limit:
                break
        if cost + penalty < lowest and reach > 0:
            lowest, pick, middle = cost + penalty, n, cost
        if n == NEARER:
            side = cost
        elif n == FARTHER:
            peak = min(side, cost) - center
            if peak > 0 and reach > 0:
                moved = tries[OWN, 0] + move * _minimum_between(cost, center, side)
    tries[OWN, 0] = moved
    return pick, middle, peak


@inlined
@no_type_check
def _refine_all(
    reference, guide, usable, flat, seen, lenses, surface, offsets, noise, edge, price, step, reach, patch, weights,
    first, left, chosen, bases, tries, beside, new, cost, peak,
):  # fmt: skip
    """`refine` into given arrays: nothing is allocated here."""
    h, w = reference.shape
    sources = (flat, seen, lenses, h, w)
    margin = 0
    for k in range(offsets.shape[1]):
        margin = max(margin, int(offsets[0, k]))
    margin_f = np.float32(margin)
    for y in range(margin, h - margin):
        for x in range(margin, w - margin):
            if not usable[y, x]:
                continue
            mean, variance, textured = _bilateral_window(reference, guide, offsets, noise, edge, y, x, patch, weights)
            if not textured:
                continue
            view = (offsets, patch, weights, mean, variance, noise)
            _at_infinity(lenses, y, x, bases)
            q = surface[y, x, 0]
            _every_source(sources, bases, q, surface[y, x, 1], surface[y, x, 2], view, first)
            kept, center = _choose(first, left, chosen)
            speed = _fastest(lenses, bases, q, chosen, kept)
            move = step / speed
            _propose(surface, y, x, reach, move, tries, beside)
            pick, cost[y, x], peak[y, x] = _best_candidate(
                sources, bases, view, chosen, kept, speed, tries, beside, center, margin_f, price, reach, move
            )
            for k in range(3):
                new[y, x, k] = tries[pick, k]


@kernel
@no_type_check
def refine(
    reference, guide, usable, flat, seen, lenses, surface, offsets, noise, edge, keep, smooth, step, reach,
    stamp=SOURCES,
):  # fmt: skip
    """One round of slanted-plane refinement: every pixel tries its neighbors' planes and small moves of its own.

    `surface` [h, w, 3] holds q and its slopes along x and y; `flat` [s, h, w] the sources' packed images, `lenses`
    [s, 12] their H and e. Windows (`window`) weigh pixels by likeness to their center (bilateral), which keeps depth
    edges on image edges. `step` is the trial move in source pixels, `reach` the distance of the neighbors asked (0:
    nothing moves, the surface is only judged), `smooth` the price of one source pixel of disagreement with the four
    nearest. All pixels read the state of the round before, so order does not matter. Returns the new surface, its cost
    (1 - NCC), and `peak`: how much the cost of the old one rises by `step`.
    """
    h, w = reference.shape
    count = flat.shape[0]
    new = surface.copy()
    cost, peak = np.ones((h, w), np.float32), np.zeros((h, w), np.float32)
    window_values = np.empty((2, offsets.shape[1]), np.float32)
    per_source, chosen = np.empty((5, count), np.float32), np.empty(keep, np.int64)
    planes = np.empty((CANDIDATES, 3), np.float32), np.empty(4, np.float32)
    _refine_all(
        reference, guide, usable, flat.ravel(), seen.ravel(), lenses, surface, offsets, np.float32(noise),
        np.float32(edge), np.float32(0.25 * smooth), np.float32(step), reach, window_values[0], window_values[1],
        per_source[0], per_source[1], chosen, per_source[2:].T, planes[0], planes[1], new, cost, peak,
    )  # fmt: skip
    return new, cost, peak
