"""Conditioning for a block of primitives at a time, and its closed-form gradient: the fast form of `conditioning`.

With W = L21^T V22^-1 diag(lambda) and V22 = Lc Lc^T, the conditional of
docs/derivations/beta-primitives.md#conditioning never forms V12:

    m = mu + L11 W x,   S = L11 (I - W L21) L11^T,   opacity = o exp(sum_j B_j (ln 2 - softplus(2 y_j^2)))

float32, R = I + A. `load`, `condition` and `conditioning_gradients` are inlined into the kernel of `cpu_project`.
The gradient is that of docs/derivations/gradients.md#conditioning in factored form; D_ names the loss's gradient by a
quantity.
"""

from typing import Any, NamedTuple, no_type_check

import numpy as np

from swimm3r.raster.cpu.math import inlined
from swimm3r.splat.projection.cpu_matrices import (  # fmt: skip
    ADD,
    ONE,
    SIZE_1,
    SIZE_3,
    SIZE_C,
    TWO,
    ZERO,
    cholesky,
    exp,
    inverse_of_lower,
    log1p,
    product,
    product_at,
    product_bt,
    products,
    run,
    zero,
)

FOUR = np.float32(4.0)
LN_2 = np.float32(0.6931471805599453)
LARGEST_BETA = np.float32(20.0)  # before the exponential: keeps it finite
NEAREST = np.float32(1e-24)  # squared distance

# Matrices of the workspace; no Python ints, for each of which Numba would compile the products anew. Of S, SLOPE, B and
# D_S, D_B row 0 is spatial, row 1 one entry per conditioned dimension.
(XYZ, S, SLOPE, B, O, R, L11, L21, L22, V22, LC, T, U, Q, W, X, DIRECTION, DISTANCE, WX, MEAN, N, A, COV, Y, LOG_SHARE,
 TANH, OC, D_MEAN, D_COV, D_S, D_B, D_L11, D_WX, D_N, D_W, D_Q, D_X, D_Y, D_L21, D_L22, D_V22, D_P, P, PHI, K,
 SCRATCH, FOOTPRINT2) = map(np.uintp, range(47))  # fmt: skip
MATRICES = 47

_V22 = products(
    product_bt(V22, L21, L21, SIZE_C, SIZE_3, SIZE_C),
    product_bt(V22, L22, L22, SIZE_C, SIZE_C, SIZE_C, ADD),
)
_PRECISION = products(
    product(U, T, L21, SIZE_C, SIZE_C, SIZE_3),
    product_at(Q, U, T, SIZE_3, SIZE_C, SIZE_C),
)
_CONDITIONAL = products(
    product(WX, W, X, SIZE_3, SIZE_C, SIZE_1),
    product(MEAN, L11, WX, SIZE_3, SIZE_3, SIZE_1, ADD),
    product(N, W, L21, SIZE_3, SIZE_C, SIZE_3, ADD, halves=-2),
    product(A, L11, N, SIZE_3, SIZE_3, SIZE_3),
    product_bt(COV, A, L11, SIZE_3, SIZE_3, SIZE_3),
    product(Y, T, X, SIZE_C, SIZE_C, SIZE_1),
)
_D_CONDITIONAL = products(
    product_bt(D_L11, D_MEAN, WX, SIZE_3, SIZE_1, SIZE_3),
    product(SCRATCH, D_COV, L11, SIZE_3, SIZE_3, SIZE_3),
    product_bt(D_L11, SCRATCH, N, SIZE_3, SIZE_3, SIZE_3, ADD),
    product_at(D_L11, D_COV, A, SIZE_3, SIZE_3, SIZE_3, ADD),
    product_at(D_N, L11, SCRATCH, SIZE_3, SIZE_3, SIZE_3),
    product_at(D_WX, L11, D_MEAN, SIZE_3, SIZE_3, SIZE_1),
    product_bt(D_W, D_WX, X, SIZE_3, SIZE_1, SIZE_C),
    product_bt(D_W, D_N, L21, SIZE_3, SIZE_3, SIZE_C, ADD, halves=-2),
    product_at(D_X, W, D_WX, SIZE_C, SIZE_3, SIZE_1),
    product_at(D_L21, W, D_N, SIZE_C, SIZE_3, SIZE_3, halves=-2),
)
_D_PRECISION = products(
    product_at(P, T, T, SIZE_C, SIZE_C, SIZE_C),
    product_bt(D_L21, P, D_Q, SIZE_C, SIZE_C, SIZE_3, ADD),
    product(D_P, L21, D_Q, SIZE_C, SIZE_3, SIZE_C),
    product(SCRATCH, D_P, P, SIZE_C, SIZE_C, SIZE_C),
    product(D_V22, P, SCRATCH, SIZE_C, SIZE_C, SIZE_C, halves=-2),
)
_D_LOG_SHARE = products(
    product_at(K, T, D_Y, SIZE_C, SIZE_C, SIZE_1),
)
_D_FACTOR = products(
    product_at(PHI, LC, SCRATCH, SIZE_C, SIZE_C, SIZE_C),
)
_D_V22 = products(
    product(SCRATCH, PHI, T, SIZE_C, SIZE_C, SIZE_C, halves=1),
    product_at(D_V22, T, SCRATCH, SIZE_C, SIZE_C, SIZE_C, ADD),
)
_D_LOWER = products(
    product(D_L21, D_V22, L21, SIZE_C, SIZE_C, SIZE_3, ADD),
    product(D_L22, D_V22, L22, SIZE_C, SIZE_C, SIZE_C),
)


class Stored(NamedTuple):
    """Arrays of the primitives as a map stores them (`primitives.beta`), or of the loss's gradients by them."""

    xyz: Any  # [n, 3]
    query_mean: Any  # [n, c]
    opacity: Any  # [n]
    beta: Any  # [n, 1 + c]
    scale: Any  # [n, 3 + c]
    lower: Any  # [n, (3 + c) (2 + c) / 2]
    footprint: Any  # [n]; no gradient


@no_type_check
@inlined
def load(g, ids, first, count, stored, camera, time):
    """Gather `count` primitives (the last one again in spare lanes), activate them, and take their queries."""
    three, c = stored.xyz.shape[1], stored.query_mean.shape[1]
    for q in range(g.shape[3]):
        i = ids[first + min(q, count - 1)]
        for k in range(three):
            g[XYZ, k, 0, q] = stored.xyz[i, k]
            g[S, 0, k, q] = stored.scale[i, k]
        g[B, 0, 0, q] = stored.beta[i, 0]
        g[O, 0, 0, q] = stored.opacity[i]
        g[FOOTPRINT2, 0, 0, q] = stored.footprint[i] * stored.footprint[i]
        g[R, 0, 1, q], g[R, 0, 2, q], g[R, 1, 2, q] = stored.lower[i, 0], stored.lower[i, 1], stored.lower[i, 2]
        entry = 3
        for r in range(c):
            g[S, 1, r, q], g[B, 1, r, q] = stored.scale[i, 3 + r], stored.beta[i, 1 + r]
            g[X, r, 0, q] = stored.query_mean[i, r]
            for k in range(three):
                g[L21, r, k, q] = stored.lower[i, entry + k]
            for k in range(r):
                g[L22, r, k, q] = stored.lower[i, entry + 3 + k]
            entry += 3 + r
    for row in range(2):
        for k in range(three if row == 0 else c):
            s, slope = g[S, row, k], g[SLOPE, row, k]
            for q in range(g.shape[3]):
                e = exp(-abs(s[q]))
                slope[q] = (ONE if s[q] >= ZERO else e) / (ONE + e)
                s[q] = max(s[q], ZERO) + log1p(e)
        for k in range(1 if row == 0 else c):
            b = g[B, row, k]
            for q in range(g.shape[3]):
                b[q] = FOUR * exp(min(b[q], LARGEST_BETA))
    o, distance = g[O, 0, 0], g[DISTANCE, 0, 0]
    for q in range(g.shape[3]):
        e = exp(-abs(o[q]))
        o[q] = (ONE if o[q] >= ZERO else e) / (ONE + e)
        distance[q] = NEAREST
    for k in range(three):
        d, at, center = g[DIRECTION, k, 0], g[XYZ, k, 0], camera[12 + k]
        for q in range(g.shape[3]):
            d[q] = at[q] - center
            distance[q] += d[q] * d[q]
    for q in range(g.shape[3]):
        distance[q] = np.sqrt(distance[q])
    for k in range(c):
        x = g[X, k, 0]
        if k < 3:
            d = g[DIRECTION, k, 0]
            for q in range(g.shape[3]):
                d[q] /= distance[q]
                x[q] = d[q] - x[q]
        else:
            for q in range(g.shape[3]):
                x[q] = time - x[q]


@no_type_check
@inlined
def condition(g, three, c):
    """MEAN, COV and OC: conditional mean, covariance as formed, and opacity."""
    for i in range(three):
        one = g[R, i, i]
        for q in range(g.shape[3]):
            one[q] = ONE
        for j in range(i):
            below, above = g[R, i, j], g[R, j, i]
            for q in range(g.shape[3]):
                below[q] = -above[q]
    for i in range(three):
        for j in range(three):
            out, r, s = g[L11, i, j], g[R, i, j], g[S, 0, j]
            for q in range(g.shape[3]):
                out[q] = r[q] * s[q]
    for k in range(c):
        out, s = g[L22, k, k], g[S, 1, k]
        for q in range(g.shape[3]):
            out[q] = s[q]
    run(g, _V22, 0, three, c)
    cholesky(g, LC, V22, c)
    inverse_of_lower(g, T, LC, c)
    run(g, _PRECISION, 0, three, c)
    for i in range(three):
        for j in range(c):
            w, value, b = g[W, i, j], g[Q, i, j], g[B, 1, j]
            for q in range(g.shape[3]):
                w[q] = value[q] * min(b[q] / FOUR, ONE)
    zero(g, N, three, three)
    for i in range(three):
        mean, at, one = g[MEAN, i, 0], g[XYZ, i, 0], g[N, i, i]
        for q in range(g.shape[3]):
            mean[q] = at[q]
            one[q] = ONE
    run(g, _CONDITIONAL, 0, three, c)
    zero(g, OC, 1, 1)
    oc, o = g[OC, 0, 0], g[O, 0, 0]
    for j in range(c):
        y, log_share, tanh, b = g[Y, j, 0], g[LOG_SHARE, j, 0], g[TANH, j, 0], g[B, 1, j]
        for q in range(g.shape[3]):
            twice = TWO * y[q] * y[q]
            e = exp(-twice)
            log_share[q] = LN_2 - twice - log1p(e)
            tanh[q] = (ONE - e) / (ONE + e)
            oc[q] += b[q] * log_share[q]
    for q in range(g.shape[3]):
        oc[q] = o[q] * exp(oc[q])


@no_type_check
@inlined
def conditioning_gradients(g, ids, start, count, three, c, d_opacity, d_exponent):
    """D_S, D_L11 (of R in the end), D_L21, D_L22, D_X and D_B from D_MEAN, D_COV and what the rasterizer says."""
    run(g, _D_CONDITIONAL, 0, three, c)
    zero(g, D_B, 2, c)
    for j in range(c):
        b, d_b = g[B, 1, j], g[D_B, 1, j]
        for r in range(three):
            d_q, d_w, value = g[D_Q, r, j], g[D_W, r, j], g[Q, r, j]
            for q in range(g.shape[3]):
                d_q[q] = d_w[q] * min(b[q] / FOUR, ONE)
                d_b[q] += d_w[q] * value[q] / FOUR if b[q] < FOUR else ZERO
    # Q = L21^T P with P = V22^-1 = T^T T, so that D_V22 = -P (L21 D_Q) P
    run(g, _D_PRECISION, 0, three, c)
    # the opacity, through y = T x
    for j in range(c):
        y, d_y, b, d_b, log_share, tanh = (
            g[Y, j, 0],
            g[D_Y, j, 0],
            g[B, 1, j],
            g[D_B, 1, j],
            g[LOG_SHARE, j, 0],
            g[TANH, j, 0],
        )
        for q in range(g.shape[3]):
            d_y[q] = ZERO
        for q in range(count):
            weight = d_opacity[ids[start + q]] * g[OC, 0, 0, q]
            d_b[q] += weight * log_share[q]
            d_y[q] = -TWO * weight * b[q] * y[q] * (ONE + tanh[q])
    for q in range(count):
        g[D_B, 0, 0, q] = d_exponent[ids[start + q]]
    run(g, _D_LOG_SHARE, 0, three, c)
    # D_LC = -tril(K y^T); PHI = tril(LC^T D_LC) with its diagonal halved; D_V22 += T^T (PHI + PHI^T) T / 2
    zero(g, SCRATCH, c, c)
    for i in range(c):
        d_x, k = g[D_X, i, 0], g[K, i, 0]
        for q in range(g.shape[3]):
            d_x[q] += k[q]
        for j in range(i + 1):
            out, y = g[SCRATCH, i, j], g[Y, j, 0]
            for q in range(g.shape[3]):
                out[q] = -k[q] * y[q]
    run(g, _D_FACTOR, 0, three, c)
    for i in range(c):  # PHI + PHI^T: the diagonal, halved twice over, is right as it stands
        for j in range(i):
            above, below = g[PHI, j, i], g[PHI, i, j]
            for q in range(g.shape[3]):
                above[q] = below[q]
    run(g, _D_V22, 0, three, c)
    # V22 = L21 L21^T + L22 L22^T
    for i in range(c):
        for j in range(i + 1):
            below, above = g[D_V22, i, j], g[D_V22, j, i]
            for q in range(g.shape[3]):
                both = below[q] + above[q]
                below[q] = both
                above[q] = both
    run(g, _D_LOWER, 0, three, c)
    zero(g, D_S, 1, three)
    for j in range(three):
        d_s, s = g[D_S, 0, j], g[S, 0, j]
        for i in range(three):
            d_l, r = g[D_L11, i, j], g[R, i, j]
            for q in range(g.shape[3]):
                d_s[q] += d_l[q] * r[q]
                d_l[q] *= s[q]
