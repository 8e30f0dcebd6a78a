"""The Warp kernels of the plane sweep: one thread per pixel, or per path of the semi-global step.

The arithmetic of one pixel is `pixel_math`'s, as in the Numba kernels; what differs is what is stored. A thread makes
the window's weights anew for every patch, where the CPU keeps them in a vector; a path's costs of the pixel before lie
in global memory, interleaved so that neighboring threads read neighboring addresses. The same source runs on Warp's
"cpu" device, one thread after the other, for tests.
"""

import inspect
from collections.abc import Callable
from typing import Any, no_type_check

import warp as wp

from swimm3r.sfm.plane_sweep import pixel_math

setattr(wp.config, "quiet", True)  # noqa: B010  as in raster/cuda/launch: no banner in the middle of the progress
wp.config.log_level = 30
wp.init()

MOST_SOURCES = 16
MIN_SOURCES = wp.constant(2)
CANDIDATES = wp.constant(8)
NEARER, FARTHER = wp.constant(5), wp.constant(6)
NEVER, FAR = wp.constant(1.0e9), wp.constant(1.0e9)
costs_type = wp.types.vector(length=MOST_SOURCES, dtype=float)


def _function(f: Callable[..., Any]) -> Any:
    """wp.func of a pixel function: its arguments are floats."""
    f.__annotations__ = dict.fromkeys(inspect.signature(f).parameters, float)
    return wp.func(f)


_pixel = pixel_math.make(_function, wp.min, wp.max, wp.where, wp.sqrt, float)
row_times, ahead, clamped, inside = _pixel.row_times, _pixel.ahead, _pixel.clamped, _pixel.inside
bilinear, ncc_cost, likeness = _pixel.bilinear, _pixel.ncc_cost, _pixel.likeness
pixels_per_q, extended, differs = _pixel.pixels_per_q, _pixel.extended, _pixel.differs
disagreement, minimum_between, mean_slope = _pixel.disagreement, _pixel.minimum_between, _pixel.mean_slope
jump_price, path_cost = _pixel.jump_price, _pixel.path_cost


@no_type_check
@wp.func
def point(lenses: wp.array2d(dtype=float), n: int, x: float, y: float, q: float):
    """The homogeneous point of source n on which a pixel at inverse depth q lands."""
    return wp.vec3(
        row_times(lenses[n, 0], lenses[n, 1], lenses[n, 2], x, y) + q * lenses[n, 9],
        row_times(lenses[n, 3], lenses[n, 4], lenses[n, 5], x, y) + q * lenses[n, 10],
        row_times(lenses[n, 6], lenses[n, 7], lenses[n, 8], x, y) + q * lenses[n, 11],
    )


@no_type_check
@wp.func
def sample(flat: wp.array3d(dtype=int), n: int, u: float, v: float):
    """The image of source n between four pixels; two share an integer."""
    i, j = int(u), int(v)
    upper, lower = flat[n, j, i], flat[n, j + 1, i]
    return bilinear(
        float((upper << 16) >> 16), float(upper >> 16), float((lower << 16) >> 16), float(lower >> 16),
        u - float(i), v - float(j),
    )  # fmt: skip


@no_type_check
@wp.func
def sees(seen: wp.array3d(dtype=wp.uint8), n: int, P: wp.vec3, most_u: float, most_v: float):
    """Return whether source n sees a point."""
    if not inside(P[0], P[1], P[2], most_u, most_v):
        return False
    return seen[n, int(P[1] / P[2]), int(P[0] / P[2])] > wp.uint8(0)


@no_type_check
@wp.func
def mean_of_best(costs: costs_type, count: int, keep: int):
    """The mean of the `keep` smallest of the first `count` values."""
    total = float(0.0)
    for _ in range(keep):
        best = int(0)
        for s in range(1, count):
            if costs[s] < costs[best]:
                best = s
        total += costs[best]
        costs[best] = NEVER
    return total / float(keep)


@no_type_check
@wp.kernel(enable_backward=False)
def sweep_costs(
    reference: wp.array2d(dtype=float), flat: wp.array3d(dtype=int), seen: wp.array3d(dtype=wp.uint8),
    lenses: wp.array2d(dtype=float), planes: wp.array(dtype=float), radius: int, noise: float, keep: int,
    volume: wp.array3d(dtype=float),
):  # fmt: skip
    """Cost volume [planes, h, w]: the mean over the `keep` sources that agree best with each plane."""
    d, y, x = wp.tid()
    h, w = reference.shape[0], reference.shape[1]
    most_u, most_v = float(w) - 1.01, float(h) - 1.01
    q = planes[d]
    costs = costs_type()
    for n in range(flat.shape[0]):
        costs[n] = 1.0
        if sees(seen, n, point(lenses, n, float(x), float(y), q), most_u, most_v):
            r_sum, rr_sum, s_sum, ss_sum = float(0.0), float(0.0), float(0.0), float(0.0)
            rs_sum, count = float(0.0), float(0.0)
            for j in range(wp.max(0, y - radius), wp.min(h, y + radius + 1)):
                for i in range(wp.max(0, x - radius), wp.min(w, x + radius + 1)):
                    P = point(lenses, n, float(i), float(j), q)
                    s = float(0.0)
                    if sees(seen, n, P, most_u, most_v):
                        s = sample(flat, n, P[0] / P[2], P[1] / P[2])
                    r = reference[j, i]
                    r_sum += r
                    rr_sum += r * r
                    s_sum += s
                    ss_sum += s * s
                    rs_sum += r * s
                    count += 1.0
            mean = r_sum / count
            variance = wp.max(rr_sum / count - mean * mean, 0.0)
            costs[n] = ncc_cost(s_sum / count, ss_sum / count, rs_sum / count, mean, variance, noise)
    volume[d, y, x] = mean_of_best(costs, flat.shape[0], keep)


@no_type_check
@wp.kernel(enable_backward=False)
def follow_paths(
    volume: wp.array3d(dtype=float), guide: wp.array2d(dtype=float), one_plane: float, any_jump: float, edge: float,
    dy: int, dx: int, kept: wp.array3d(dtype=float), total: wp.array3d(dtype=float),
):  # fmt: skip
    """Add the costs along every path of one direction to `total` (Hirschmueller 2008).

    A thread follows one path; the first w begin at the image's first row, the others at its first column, as seen along
    the direction. `kept` [2, planes, paths] holds the costs of the pixel before and of this one.
    """
    line = wp.tid()
    planes, h, w = volume.shape[0], volume.shape[1], volume.shape[2]
    y = wp.where(dy >= 0, 0, h - 1)
    x = wp.where(dx >= 0, 0, w - 1)
    if line < w:
        if dy == 0:
            return
        x = line
    else:
        if dx == 0:
            return
        y = line - w
        if dy != 0 and y == wp.where(dy > 0, 0, h - 1):
            return  # that corner's path begins in the first row
    least = float(0.0)
    steps = int(0)
    while y >= 0 and y < h and x >= 0 and x < w:
        now, before = steps % 2, 1 - steps % 2
        jump = float(0.0)
        if steps > 0:
            jump = jump_price(guide[y, x] - guide[y - dy, x - dx], one_plane, any_jump, edge)
        lowest = float(FAR)
        for d in range(planes):
            value = volume[d, y, x]
            if steps > 0:
                below, above = float(FAR), float(FAR)
                if d > 0:
                    below = kept[before, d - 1, line]
                if d + 1 < planes:
                    above = kept[before, d + 1, line]
                value = path_cost(value, kept[before, d, line], below, above, least, jump, one_plane)
            kept[now, d, line] = value
            total[d, y, x] += value
            lowest = wp.min(lowest, value)
        least = lowest
        steps += 1
        y += dy
        x += dx


@no_type_check
@wp.kernel(enable_backward=False)
def best_plane(total: wp.array3d(dtype=float), planes: wp.array(dtype=float), q: wp.array2d(dtype=float)):
    """Inverse depth of the cheapest plane, between planes by a parabola; planes are evenly spaced."""
    y, x = wp.tid()
    count = total.shape[0]
    d = int(0)
    for k in range(1, count):
        if total[k, y, x] < total[d, y, x]:
            d = k
    shift = float(0.0)
    if d > 0 and d < count - 1:
        shift = minimum_between(total[d - 1, y, x], total[d, y, x], total[d + 1, y, x])
    q[y, x] = planes[d] + shift * (planes[1] - planes[0])


@no_type_check
@wp.func
def patch_cost(
    reference: wp.array2d(dtype=float), guide: wp.array2d(dtype=float), flat: wp.array3d(dtype=int),
    seen: wp.array3d(dtype=wp.uint8), lenses: wp.array2d(dtype=float), offsets: wp.array2d(dtype=float), n: int, y: int,
    x: int, plane: wp.vec3, moments: wp.vec3, noise: float, edge: float,
):  # fmt: skip
    """1 - weighted NCC of one window between the reference and source n; `moments`: mean, variance, sum of weights."""
    h, w = reference.shape[0], reference.shape[1]
    most_u, most_v = float(w) - 1.01, float(h) - 1.01
    if not sees(seen, n, point(lenses, n, float(x), float(y), plane[0]), most_u, most_v):
        return float(1.0)
    s_sum, ss_sum, rs_sum = float(0.0), float(0.0), float(0.0)
    for k in range(offsets.shape[1]):
        dx, dy = offsets[0, k], offsets[1, k]
        i, j = x + int(dx), y + int(dy)
        P = point(lenses, n, float(i), float(j), extended(plane[0], plane[1], plane[2], dx, dy))
        z = ahead(P[2])
        s = sample(flat, n, clamped(P[0] / z, most_u), clamped(P[1] / z, most_v))
        weighted = likeness(guide[j, i] - guide[y, x], edge) * offsets[2, k] / moments[2] * s
        s_sum += weighted
        ss_sum += weighted * s
        rs_sum += weighted * reference[j, i]
    return ncc_cost(s_sum, ss_sum, rs_sum, moments[0], moments[1], noise)


@no_type_check
@wp.func
def plane_at(surface: wp.array3d(dtype=float), y: int, x: int, dy: int, dx: int):
    """The plane of pixel (y + dy, x + dx), extended to (y, x)."""
    gx, gy = surface[y + dy, x + dx, 1], surface[y + dy, x + dx, 2]
    return wp.vec3(extended(surface[y + dy, x + dx, 0], gx, gy, -float(dx), -float(dy)), gx, gy)


@no_type_check
@wp.func
def candidate(surface: wp.array3d(dtype=float), y: int, x: int, n: int, reach: int, move: float):
    """The n-th candidate plane, in the order of `refinement`."""
    own = plane_at(surface, y, x, 0, 0)
    if n == NEARER:
        return wp.vec3(own[0] + move, own[1], own[2])
    if n == FARTHER:
        return wp.vec3(own[0] - move, own[1], own[2])
    if n == 7:
        return wp.vec3(
            own[0], mean_slope(surface[y, x - 2, 0], surface[y, x + 2, 0]),
            mean_slope(surface[y - 2, x, 0], surface[y + 2, x, 0]),
        )  # fmt: skip
    side = wp.where(n % 2 == 1, -reach, reach)  # 1 .. 4: left, right, above, below
    if n <= 2:
        return plane_at(surface, y, x, 0, side)
    return plane_at(surface, y, x, side, 0)


@no_type_check
@wp.func
def roughness(surface: wp.array3d(dtype=float), y: int, x: int, q: float, speed: float):
    """Disagreement with the four nearest pixels' planes, source pixels."""
    left, right = plane_at(surface, y, x, 0, -1), plane_at(surface, y, x, 0, 1)
    above, below = plane_at(surface, y, x, -1, 0), plane_at(surface, y, x, 1, 0)
    return (
        disagreement(left[0], q, speed) + disagreement(right[0], q, speed)
        + disagreement(above[0], q, speed) + disagreement(below[0], q, speed)
    )  # fmt: skip


@no_type_check
@wp.func
def window_moments(
    reference: wp.array2d(dtype=float), guide: wp.array2d(dtype=float), offsets: wp.array2d(dtype=float), y: int,
    x: int, noise: float, edge: float,
):  # fmt: skip
    """Mean, variance and sum of weights of a bilateral window; no weights where the center's likes have no texture."""
    total, mean, square = float(0.0), float(0.0), float(0.0)
    alike, inner, inner_square = float(0.0), float(0.0), float(0.0)
    for k in range(offsets.shape[1]):
        i, j = x + int(offsets[0, k]), y + int(offsets[1, k])
        weight = likeness(guide[j, i] - guide[y, x], edge) * offsets[2, k]
        value = reference[j, i]
        total += weight
        mean += weight * value
        square += weight * value * value
        alike += weight * weight
        inner += weight * weight * value
        inner_square += weight * weight * value * value
    mean /= total
    textured = inner_square * alike - inner * inner >= noise * alike * alike
    return wp.vec3(mean, wp.max(square / total - mean * mean, 0.0), wp.where(textured, total, 0.0))


@no_type_check
@wp.kernel(enable_backward=False)
def refine(
    reference: wp.array2d(dtype=float), guide: wp.array2d(dtype=float), usable: wp.array2d(dtype=wp.uint8),
    flat: wp.array3d(dtype=int), seen: wp.array3d(dtype=wp.uint8), lenses: wp.array2d(dtype=float),
    surface: wp.array3d(dtype=float), offsets: wp.array2d(dtype=float), noise: float, edge: float, keep: int,
    smooth: float, step: float, reach: int, margin: int, out: wp.array3d(dtype=float), cost: wp.array2d(dtype=float),
    peak: wp.array2d(dtype=float),
):  # fmt: skip
    """One round of slanted-plane refinement, as `refinement.refine` describes it."""
    y, x = wp.tid()
    h, w = reference.shape[0], reference.shape[1]
    own = plane_at(surface, y, x, 0, 0)
    for k in range(3):
        out[y, x, k] = own[k]
    cost[y, x] = 1.0
    peak[y, x] = 0.0
    if y < margin or x < margin or y >= h - margin or x >= w - margin or usable[y, x] == wp.uint8(0):
        return
    moments = window_moments(reference, guide, offsets, y, x, noise, edge)
    if moments[2] == 0.0:
        return
    left = costs_type()
    for s in range(flat.shape[0]):
        left[s] = patch_cost(reference, guide, flat, seen, lenses, offsets, s, y, x, own, moments, noise, edge)
    chosen = int(0)  # one bit per source
    kept = int(0)
    speed, center = float(1.0e-12), float(0.0)
    for n in range(keep):
        best = int(0)
        for s in range(1, flat.shape[0]):
            if left[s] < left[best]:
                best = s
        if n < MIN_SOURCES or left[best] < 1.0:
            P = point(lenses, best, float(x), float(y), own[0])
            speed = wp.max(speed, pixels_per_q(P[0], P[1], P[2], lenses[best, 9], lenses[best, 10], lenses[best, 11]))
            center += left[best]
            left[best] = NEVER
            chosen = chosen | (1 << best)
            kept += 1
    center /= float(kept)
    move = step / speed
    price = 0.25 * smooth
    pick, moved, middle, lowest = int(0), own[0], float(1.0), float(NEVER)
    side, rise = float(1.0), float(0.0)
    if own[0] > 0.0:
        lowest, middle = center + price * roughness(surface, y, x, own[0], speed), center
    for n in range(1, CANDIDATES):
        along = n == NEARER or n == FARTHER
        if reach > 0 or along:
            tried = candidate(surface, y, x, n, reach, move)
            if differs(tried[0], tried[1], tried[2], own[0], own[1], own[2], float(margin), speed):
                penalty = price * roughness(surface, y, x, tried[0], speed)
                limit = wp.where(along, float(NEVER), lowest - penalty)
                total = float(0.0)
                for s in range(flat.shape[0]):
                    if (chosen & (1 << s)) != 0 and total < limit:
                        total += patch_cost(
                            reference, guide, flat, seen, lenses, offsets, s, y, x, tried, moments, noise, edge
                        ) / float(kept)
                if total + penalty < lowest and reach > 0:
                    lowest, pick, middle = total + penalty, n, total
                if n == NEARER:
                    side = total
                if n == FARTHER:
                    rise = wp.min(side, total) - center
                    if rise > 0.0 and reach > 0:
                        moved = own[0] + move * minimum_between(total, center, side)
    result = wp.vec3(moved, own[1], own[2])
    if pick > 0:
        result = candidate(surface, y, x, pick, reach, move)
    for k in range(3):
        out[y, x, k] = result[k]
    cost[y, x] = middle
    peak[y, x] = rise
