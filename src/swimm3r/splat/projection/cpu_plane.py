"""From the conditioned primitives of a block to the image plane, and their gradients: parts of `cpu_project`.

The gradients are those of docs/derivations/gradients.md#projection; D_ names the loss's gradient by a quantity. `lens`
is None of a pinhole, else k1 to k4 of a fisheye: Numba compiles a kernel for either, without the code of the other.
"""

from typing import Any, NamedTuple, no_type_check

import numpy as np

from swimm3r.raster.cpu.math import inlined
from swimm3r.splat.projection.cpu_conditioning import (  # fmt: skip
    COV,
    D_B,
    D_COV,
    D_L11,
    D_L21,
    D_L22,
    D_MEAN,
    D_S,
    D_X,
    DIRECTION,
    DISTANCE,
    FOOTPRINT2,
    MATRICES,
    MEAN,
    OC,
    SLOPE,
    B,
    O,
)
from swimm3r.splat.projection.cpu_fisheye import bend, bend_gradients
from swimm3r.splat.projection.cpu_matrices import (
    HALF,
    ONE,
    SIZE_1,
    SIZE_2,
    SIZE_3,
    TWO,
    ZERO,
    product,
    product_at,
    product_bt,
    products,
    run,
    zero,
)

LEAST_SPREAD = np.float32(0.01)
POSE = 15  # gradient of R (9), t (3), center (3)
# of the camera array, after R, t, center; WORLD and ON_PLANE begin the two numbers each of `pixel_filter.Widening`
(FX, FY, CX, CY, X_LOW, X_HIGH, Y_LOW, Y_HIGH, NEAR, UPPER, WORLD) = range(15, 26)
ON_PLANE = WORLD + 2
# matrices after those of conditioning
(AT, J, RV, COV_SEEN, M, M_COV, PLANE, D_AT, D_M, D_J, D_PLANE, D_WIDTH, OUTER, BENT) = map(
    np.uintp, range(MATRICES, MATRICES + 14)
)
WORKSPACE = MATRICES + 14  # matrices in all; row 0 of BENT is A, B, C of `cpu_fisheye` and A + s B

_ONTO_PLANE = products(
    product(M, J, RV, SIZE_2, SIZE_3, SIZE_3),
    product(M_COV, M, COV_SEEN, SIZE_2, SIZE_3, SIZE_3),
    product_bt(PLANE, M_COV, M, SIZE_2, SIZE_3, SIZE_2),
)
_D_JACOBIAN = products(
    product(D_M, D_PLANE, M_COV, SIZE_2, SIZE_2, SIZE_3, halves=4),
    product_bt(D_J, D_M, RV, SIZE_2, SIZE_3, SIZE_3),
)
_D_WORLD = products(
    product_at(OUTER, M, D_PLANE, SIZE_3, SIZE_2, SIZE_2),
    product(D_COV, OUTER, M, SIZE_3, SIZE_2, SIZE_3),
    product_at(D_MEAN, RV, D_AT, SIZE_3, SIZE_3, SIZE_1),
)


class OnPlane(NamedTuple):
    """Arrays of the primitives on the image plane, or of the loss's gradients by them."""

    mean2d: Any  # [n, 2]
    conic: Any  # [n, 3]
    opacity: Any  # [n]
    exponent: Any  # [n]
    depth: Any  # [n]
    radius: Any  # [n]; empty among gradients


@no_type_check
@inlined
def onto_plane(g, camera, lens, three, two):
    """AT in camera axes and PLANE, the widened covariance on the image plane of the widened one in the world."""
    for i in range(three):
        at, x, y, z = g[AT, i, 0], g[MEAN, 0, 0], g[MEAN, 1, 0], g[MEAN, 2, 0]
        r0, r1, r2, t = camera[3 * i], camera[3 * i + 1], camera[3 * i + 2], camera[9 + i]
        for q in range(g.shape[3]):
            at[q] = r0 * x[q] + r1 * y[q] + r2 * z[q] + t
        for j in range(three):
            upper, lower, seen, rotation = (
                g[COV, min(i, j), max(i, j)],
                g[COV, max(i, j), min(i, j)],
                g[COV_SEEN, i, j],
                g[RV, i, j],
            )
            mix, r = ONE if camera[UPPER] > ZERO else HALF, camera[3 * i + j]
            for q in range(g.shape[3]):
                seen[q] = mix * upper[q] + (ONE - mix) * lower[q]
                rotation[q] = r
    if lens is None:
        pinhole_jacobian(g, camera, two)
    else:
        fisheye_jacobian(g, camera, lens)
    exponent, footprint2 = g[B, 0, 0], g[FOOTPRINT2, 0, 0]
    for k in range(three):
        seen, u, v = g[COV_SEEN, k, k], camera[WORLD], camera[WORLD + 1]
        for q in range(g.shape[3]):
            seen[q] += (u + v * exponent[q]) * footprint2[q]
    run(g, _ONTO_PLANE, two, three, 0)
    for axis in range(two):
        variance, u, v = g[PLANE, axis, axis], camera[ON_PLANE], camera[ON_PLANE + 1]
        for q in range(g.shape[3]):
            variance[q] += u + v * exponent[q]


@no_type_check
@inlined
def pinhole_jacobian(g, camera, two):
    """J at the clamped ray."""
    for axis in range(two):
        f, low, high = camera[FX + axis], camera[X_LOW + 2 * axis], camera[X_HIGH + 2 * axis]
        at, z, straight, slant = g[AT, axis, 0], g[AT, 2, 0], g[J, axis, axis], g[J, axis, 2]
        for q in range(g.shape[3]):
            inverse = ONE / max(z[q], camera[NEAR])
            straight[q] = f * inverse
            slant[q] = -f * inverse * min(max(at[q] * inverse, low), high)


@no_type_check
@inlined
def fisheye_jacobian(g, camera, lens):
    """J at the primitive, and BENT."""
    for q in range(g.shape[3]):
        z = max(np.float64(g[AT, 2, 0, q]), np.float64(camera[NEAR]))
        x, y = g[AT, 0, 0, q] / z, g[AT, 1, 0, q] / z
        s = x * x + y * y
        A, B, C = bend(s, lens)
        mixed, ahead = B * x * y, A + s * B
        g[BENT, 0, 0, q], g[BENT, 0, 1, q], g[BENT, 0, 2, q], g[BENT, 0, 3, q] = A, B, C, ahead
        fx, fy = camera[FX] / z, camera[FY] / z
        g[J, 0, 0, q], g[J, 0, 1, q], g[J, 0, 2, q] = fx * (A + B * x * x), fx * mixed, -fx * ahead * x
        g[J, 1, 0, q], g[J, 1, 1, q], g[J, 1, 2, q] = fy * mixed, fy * (A + B * y * y), -fy * ahead * y


@no_type_check
@inlined
def hidden(g, q, camera, lens):
    """Return whether lane q is behind the camera, or where the image of its lens no longer grows with the angle."""
    if lens is None:
        return g[AT, 2, 0, q] <= camera[NEAR]
    return g[AT, 2, 0, q] <= camera[NEAR] or g[BENT, 0, 3, q] <= ZERO


@no_type_check
@inlined
def center_gradient(g, q, camera, lens, u, v, depth):
    """D_AT of lane q by the gradients of its center and depth."""
    if lens is None:
        fx, fy = camera[FX], camera[FY]
        x, y, z = g[AT, 0, 0, q], g[AT, 1, 0, q], g[AT, 2, 0, q]
        g[D_AT, 0, 0, q], g[D_AT, 1, 0, q] = fx / z * u, fy / z * v
        g[D_AT, 2, 0, q] = depth - (fx * x * u + fy * y * v) / (z * z)
    else:
        for k in range(3):
            g[D_AT, k, 0, q] = g[J, 0, k, q] * u + g[J, 1, k, q] * v
        g[D_AT, 2, 0, q] += depth


@no_type_check
@inlined
def plane_gradients(g, ids, start, count, camera, lens, three, two, d):
    """D_AT, D_M, D_COV and D_MEAN of centers, conics and depths (docs/derivations/gradients.md#projection).

    D_WIDTH is the gradient of the exponents that comes through the widening.
    """
    zero(g, D_AT, three, 1)
    zero(g, D_PLANE, two, two)
    for q in range(count):
        i = ids[start + q]
        a, b, c = g[PLANE, 0, 0, q], g[PLANE, 0, 1, q], g[PLANE, 1, 1, q]
        det = a * c - b * b
        if hidden(g, q, camera, lens) or det <= ZERO:
            continue
        center_gradient(g, q, camera, lens, d.mean2d[i, 0], d.mean2d[i, 1], d.depth[i])
        xx, xy, yy = c / det, -b / det, a / det
        g00, g01, g11 = d.conic[i, 0], HALF * d.conic[i, 1], d.conic[i, 2]
        r00, r01, r10, r11 = g00 * xx + g01 * xy, g00 * xy + g01 * yy, g01 * xx + g11 * xy, g01 * xy + g11 * yy
        g[D_PLANE, 0, 0, q], g[D_PLANE, 0, 1, q] = -(xx * r00 + xy * r10), -(xx * r01 + xy * r11)
        g[D_PLANE, 1, 0, q], g[D_PLANE, 1, 1, q] = g[D_PLANE, 0, 1, q], -(xy * r01 + yy * r11)
    run(g, _D_JACOBIAN, two, three, 0)
    if lens is None:
        pinhole_gradients(g, camera, two)
    else:
        fisheye_gradients(g, camera)
    run(g, _D_WORLD, two, three, 0)
    d_width, footprint2 = g[D_WIDTH, 0, 0], g[FOOTPRINT2, 0, 0]
    for q in range(g.shape[3]):
        in_world = g[D_COV, 0, 0, q] + g[D_COV, 1, 1, q] + g[D_COV, 2, 2, q]
        on_plane = g[D_PLANE, 0, 0, q] + g[D_PLANE, 1, 1, q]
        d_width[q] = camera[WORLD + 1] * footprint2[q] * in_world + camera[ON_PLANE + 1] * on_plane
    if camera[UPPER] > ZERO:
        for i in range(three):
            for j in range(i):
                for q in range(g.shape[3]):
                    g[D_COV, j, i, q] += g[D_COV, i, j, q]
                    g[D_COV, i, j, q] = ZERO


@no_type_check
@inlined
def pinhole_gradients(g, camera, two):
    """Add to D_AT the gradients that come through J."""
    for axis in range(two):
        f, low, high = camera[FX + axis], camera[X_LOW + 2 * axis], camera[X_HIGH + 2 * axis]
        at, z, d_at, d_z = g[AT, axis, 0], g[AT, 2, 0], g[D_AT, axis, 0], g[D_AT, 2, 0]
        straight, slant = g[D_J, axis, axis], g[D_J, axis, 2]
        for q in range(g.shape[3]):
            inverse = ONE / max(z[q], camera[NEAR])
            s, v = at[q] * inverse, f * slant[q]
            inside = low <= s <= high  # beyond, J follows z alone
            d_at[q] -= v * inverse * inverse if inside else ZERO
            d_z[q] -= (f * straight[q] - v * (TWO * s if inside else min(max(s, low), high))) * inverse * inverse


@no_type_check
@inlined
def fisheye_gradients(g, camera):
    """Add to D_AT the gradients that come through J."""
    for q in range(g.shape[3]):
        z = max(np.float64(g[AT, 2, 0, q]), np.float64(camera[NEAR]))
        x, y = g[AT, 0, 0, q] / z, g[AT, 1, 0, q] / z
        bent = np.float64(g[BENT, 0, 0, q]), np.float64(g[BENT, 0, 1, q]), np.float64(g[BENT, 0, 2, q])
        fx, fy = np.float64(camera[FX]), np.float64(camera[FY])
        h = fx * g[D_J, 0, 2, q], fy * g[D_J, 1, 2, q]
        e = (
            fx * g[D_J, 0, 0, q] - h[0] * x,
            fx * g[D_J, 0, 1, q] - h[0] * y,
            fy * g[D_J, 1, 0, q] - h[1] * x,
            fy * g[D_J, 1, 1, q] - h[1] * y,
        )
        by_x, by_y, total = bend_gradients(x, y, bent, e, h)
        g[D_AT, 0, 0, q] += by_x / (z * z)
        g[D_AT, 1, 0, q] += by_y / (z * z)
        g[D_AT, 2, 0, q] -= (x * by_x + y * by_y + total) / (z * z)


@no_type_check
@inlined
def along_view(g, q, three):
    """The part of D_X along lane q's view direction, which a unit vector does not follow."""
    along = ZERO
    for k in range(three):
        along += g[D_X, k, 0, q] * g[DIRECTION, k, 0, q]
    return along


@no_type_check
@inlined
def store_on_plane(g, ids, start, count, camera, lens, out):
    """A block on the image plane; depth and radius are 0 of what does not show."""
    for q in range(count):
        i = ids[start + q]
        x, y, z = g[AT, 0, 0, q], g[AT, 1, 0, q], g[AT, 2, 0, q]
        xx, xy, yy = g[PLANE, 0, 0, q], g[PLANE, 0, 1, q], g[PLANE, 1, 1, q]
        det = xx * yy - xy * xy
        out.opacity[i], out.exponent[i] = g[OC, 0, 0, q], g[B, 0, 0, q]
        if hidden(g, q, camera, lens) or det <= ZERO:
            out.mean2d[i, 0], out.mean2d[i, 1], out.depth[i], out.radius[i] = ZERO, ZERO, ZERO, ZERO
            out.conic[i, 0], out.conic[i, 1], out.conic[i, 2] = ONE, ZERO, ONE
            continue
        if lens is not None:
            x, y = x * g[BENT, 0, 0, q], y * g[BENT, 0, 0, q]
        out.mean2d[i, 0], out.mean2d[i, 1] = camera[FX] * x / z + camera[CX], camera[FY] * y / z + camera[CY]
        out.conic[i, 0], out.conic[i, 1], out.conic[i, 2] = yy / det, -xy / det, xx / det
        middle = HALF * (xx + yy)
        out.depth[i] = z
        out.radius[i] = np.sqrt(middle + np.sqrt(max(middle * middle - det, LEAST_SPREAD)))


@no_type_check
@inlined
def add_pose_gradients(g, count, three, pose):
    """Add a block's gradients by R and t to `pose`; those by the center come with the directions."""
    for i in range(three):
        for j in range(three):
            for q in range(count):
                pose[3 * i + j] += g[D_AT, i, 0, q] * g[MEAN, j, 0, q]
                pose[3 * i + j] += g[J, 0, i, q] * g[D_M, 0, j, q] + g[J, 1, i, q] * g[D_M, 1, j, q]
        for q in range(count):
            pose[9 + i] += g[D_AT, i, 0, q]


@no_type_check
@inlined
def store_gradients(g, ids, start, count, three, c, d_opacity, out, pose):
    """Gradients by the stored parameters of a block, through their activations; adds those by the center to `pose`."""
    for q in range(count):
        i, along = ids[start + q], along_view(g, q, three)
        for k in range(three):
            across = (g[D_X, k, 0, q] - along * g[DIRECTION, k, 0, q]) / g[DISTANCE, 0, 0, q]
            out.xyz[i, k] = g[D_MEAN, k, 0, q] + across
            pose[12 + k] -= across
            out.scale[i, k] = g[D_S, 0, k, q] * g[SLOPE, 0, k, q]
        out.opacity[i] = d_opacity[i] * g[OC, 0, 0, q] * (ONE - g[O, 0, 0, q])
        out.beta[i, 0] = (g[D_B, 0, 0, q] + g[D_WIDTH, 0, 0, q]) * g[B, 0, 0, q]
        out.lower[i, 0] = g[D_L11, 0, 1, q] - g[D_L11, 1, 0, q]
        out.lower[i, 1] = g[D_L11, 0, 2, q] - g[D_L11, 2, 0, q]
        out.lower[i, 2] = g[D_L11, 1, 2, q] - g[D_L11, 2, 1, q]
        entry = 3
        for r in range(c):
            out.query_mean[i, r] = -g[D_X, r, 0, q]
            out.beta[i, 1 + r] = g[D_B, 1, r, q] * g[B, 1, r, q]
            out.scale[i, 3 + r] = g[D_L22, r, r, q] * g[SLOPE, 1, r, q]
            for k in range(three):
                out.lower[i, entry + k] = g[D_L21, r, k, q]
            for k in range(r):
                out.lower[i, entry + 3 + k] = g[D_L22, r, k, q]
            entry += 3 + r
