"""The plane sweep's arithmetic at one pixel, written once for every processor.

A pixel x of the reference at inverse depth q lands in a source at H x + q e (homogeneous). On a plane through the
pixel, whose q changes by (gx, gy) per pixel, the point moves by (H + e g^T) per pixel, so a window needs one division
per sample. Costs are 1 - NCC,

    cost = 1 - (sum w r s - mean_r sum w s) / sqrt((var_r + noise) (sum w s^2 - (sum w s)^2 + noise)),   sum w = 1,

which neither a gain nor an offset of the source changes; windows below the noise tend to 1.

`make` is called with numba.njit and with warp's wp.func: plain scalars, no loops, no branches, no arrays.
"""

from types import SimpleNamespace
from typing import Any, no_type_check

NEAREST_Z = 1e-6
"""Floor of the third homogeneous coordinate: what lies behind the source is refused, its division must stay finite."""

SAME = 0.05
"""Source pixels: a candidate plane that differs less from the pixel's own is not tried."""

ROUGHEST = 2.0
"""Source pixels: most that the disagreement with one neighbor counts."""


@no_type_check  # the tests' type-checking hook must not wrap what a compiler reads
def make(jit: Any, minimum: Any, maximum: Any, select: Any, sqrt: Any, K: Any) -> SimpleNamespace:
    """The pixel's functions as `jit` compiles them.

    `select(c, a, b)` is a if c else b; `K` makes a constant of the working precision (a bare 2.0 would promote Numba's
    lanes to float64).
    """
    zero, quarter, half, one, two = K(0.0), K(0.25), K(0.5), K(1.0), K(2.0)
    nearest_z, same, roughest, sixteenth = K(NEAREST_Z), K(SAME), K(ROUGHEST), K(1.0 / 16.0)
    flat = K(1e-9)

    @jit
    def row_times(a, b, c, x, y):
        """One row of a matrix times (x, y, 1)."""
        return a * x + (b * y + c)

    @jit
    def ahead(z):
        """A third coordinate that can be divided by."""
        return maximum(z, nearest_z)

    @jit
    def clamped(u, most):
        """A coordinate inside 0..most."""
        return minimum(maximum(u, zero), most)

    @jit
    def inside(X, Y, Z, most_u, most_v):
        """Return whether a point lies ahead and in the source's image."""
        return nearest_z < Z and zero <= X and zero <= Y and most_u * Z > X and most_v * Z > Y

    @jit
    def bilinear(top, top_right, bottom, bottom_right, a, b):
        """A value between four."""
        upper = top + a * (top_right - top)
        lower = bottom + a * (bottom_right - bottom)
        return upper + b * (lower - upper)

    @jit
    def ncc_cost(s, ss, rs, mean, variance, noise):
        """1 - NCC, 0..1, from the weighted sums of a window and the reference's mean and variance in it."""
        covariance = rs - s * mean
        spread = maximum(ss - s * s, zero) + noise
        return clamped(one - covariance / sqrt((variance + noise) * spread), one)

    @jit
    def likeness(difference, edge):
        """The weight of a pixel by its gray value's difference from the center's: a Gaussian to 5 %, 0 from 4 sigma."""
        t = difference / edge
        left = maximum(one - t * t * sixteenth, zero)
        squared = left * left
        fourth = squared * squared
        return fourth * fourth

    @jit
    def pixels_per_q(X, Y, Z, ex, ey, ez):
        """Source pixels that a unit of q moves the point by."""
        a, b = ex * Z - X * ez, ey * Z - Y * ez
        return sqrt(a * a + b * b) / maximum(Z * Z, nearest_z * nearest_z)

    @jit
    def extended(q, gx, gy, dx, dy):
        """q of a plane at (dx, dy) from the pixel whose it is."""
        return q + gx * dx + gy * dy

    @jit
    def differs(q, gx, gy, own_q, own_gx, own_gy, margin, speed):
        """Return whether a plane lies ahead and, within a window, apart enough from the pixel's own to be tried."""
        apart = abs(q - own_q) + margin * (abs(gx - own_gx) + abs(gy - own_gy))
        return q > zero and apart * speed >= same

    @jit
    def disagreement(beside, q, speed):
        """Source pixels between a neighbor's plane and this pixel's, capped."""
        return minimum(abs(beside - q) * speed, roughest)

    @jit
    def minimum_between(left, middle, right):
        """The place of the least value of the parabola through costs at -1, 0, 1; 0 where it has no minimum."""
        bend = left - two * middle + right
        shift = half * (left - right) / maximum(bend, flat)
        return select(bend > flat, minimum(maximum(shift, -one), one), zero)

    @jit
    def jump_price(change, one_plane, any_jump, edge):
        """The price of a jump between planes: less where the guide changes by more than `edge`."""
        return maximum(one_plane, any_jump / (one + abs(change) / edge))

    @jit
    def path_cost(cost, same_plane, below, above, least, jump, one_plane):
        """One plane's cost along a path (Hirschmueller 2008): `least` is the least of the pixel before."""
        cheapest = minimum(minimum(same_plane, least + jump), minimum(below, above) + one_plane)
        return cost + cheapest - least

    @jit
    def mean_slope(before, after):
        """Slope between values two pixels to either side."""
        return quarter * (after - before)

    return SimpleNamespace(
        row_times=row_times,
        ahead=ahead,
        clamped=clamped,
        inside=inside,
        bilinear=bilinear,
        ncc_cost=ncc_cost,
        likeness=likeness,
        pixels_per_q=pixels_per_q,
        extended=extended,
        differs=differs,
        disagreement=disagreement,
        minimum_between=minimum_between,
        jump_price=jump_price,
        path_cost=path_cost,
        mean_slope=mean_slope,
    )
