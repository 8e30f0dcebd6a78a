"""The image of a fisheye lens over the plane z = 1, and its first two derivatives: parts of `cpu_plane`.

With r = (x, y) / z, s = r r^T and theta = atan |r|, a point is seen at m = A r in units of the focal lengths, and

    A = d(theta) / |r|,   B = 2 dA/ds,   C = 2 dB/ds,   D = dm/dr = A I + B r^T r

(docs/derivations/gradients.md#fisheye). float64, as B and C are differences of nearly equal numbers.
"""

from typing import no_type_check

import numpy as np

from swimm3r.raster.cpu.math import inlined

NEAR_AXIS = 1e-3  # s, below which atan(|r|) / |r| and its derivatives are a series: the next term is below 1e-11


@no_type_check
@inlined
def bend(s, k):
    """A, B, C of a lens k1 to k4 at s."""
    if s < NEAR_AXIS:
        ratio = 1 - s * (1 / 3 - s * (1 / 5 - s * (1 / 7 - s / 9)))
        first = s * (2 / 5 - s * (3 / 7 - s * (4 / 9 - s * 5 / 11))) - 1 / 3
        second = 2 / 5 - s * (6 / 7 - s * (4 / 3 - s * 20 / 11))
    else:
        t = np.sqrt(s)
        ratio = np.arctan(t) / t
        first = (1 / (1 + s) - ratio) / (2 * s)
        second = -(1 / ((1 + s) * (1 + s)) + 3 * first) / (2 * s)
    u, inverse = s * ratio * ratio, 1 / (1 + s)  # u is the squared angle
    u1, u2 = ratio * inverse, (first - ratio * inverse) * inverse
    p = 1 + u * (k[0] + u * (k[1] + u * (k[2] + u * k[3])))
    p1 = k[0] + u * (2 * k[1] + u * (3 * k[2] + u * 4 * k[3]))
    p2 = 2 * k[1] + u * (6 * k[2] + u * 12 * k[3])
    a1 = first * p + ratio * p1 * u1
    a2 = second * p + 2 * first * p1 * u1 + ratio * (p2 * u1 * u1 + p1 * u2)
    return ratio * p, 2 * a1, 4 * a2


@no_type_check
@inlined
def bend_gradients(x, y, bent, e, h):
    """Gradient by r of sum_ij E_ij D_ij where E follows r as -h^T r, and the sum itself."""
    A, B, C = bent
    e00, e01, e10, e11 = e
    d00, d01, d11 = A + B * x * x, B * x * y, A + B * y * y
    trace, mixed = e00 + e11, e01 + e10
    along = C * (e00 * x * x + mixed * x * y + e11 * y * y)
    by_x = B * ((trace + 2 * e00) * x + mixed * y) + along * x - (h[0] * d00 + h[1] * d01)
    by_y = B * ((trace + 2 * e11) * y + mixed * x) + along * y - (h[0] * d01 + h[1] * d11)
    return by_x, by_y, e00 * d00 + mixed * d01 + e11 * d11
