"""The contribution of one primitive to one pixel, forward and adjoint, written once for every back end.

    alpha = min(0.999, o f(r2)),  f = (1 - r2)^b or e^{-b r2}           F = c e^{-beta_D z} - B_inf e^{-beta_B z}
    w = T alpha,  T <- T (1 - alpha)                                    I = B_inf + sum w F,  J = sum w c,  D = sum w z

Both kernels are f = 2^(b l), l = log2(1 - r2) or -r2 log2 e, and fall by b f / u per r2, u = 1 - r2 or 1: the pair
(u, l) is all that tells them apart, and b = 1/2 makes the Gaussian of 3DGS.

The adjoint walks front to back again. With a payload e_i = dL/dw_i per branch of Alg. 1 and R_i = sum_{j > i} w_j e_j,
which is the total known from the forward images minus the running sum,

    dL/dalpha_i = T_i e_i - R_i / (1 - alpha_i)              (docs/derivations/compositing.md#the-adjoint-of-alpha)

`make` is called with numba.njit and with warp's wp.func: plain scalars, no loops, no branches, no arrays.
"""

from types import SimpleNamespace
from typing import Any, no_type_check

from swimm3r.raster.records import ALPHA_MAX, T_MIN

LOG2_E = 1.4426950408889634
LN_2 = 0.6931471805599453

U_MIN = 1e-6
"""Floor of 1 - r2: at b < 1 the slope u^(b - 1) has no bound at the rim, and float32 knows u no better there."""


@no_type_check  # the tests' type-checking hook must not wrap what a compiler reads
def make(jit: Any, exp2: Any, log2: Any, minimum: Any, maximum: Any, select: Any, vec3: Any, K: Any) -> SimpleNamespace:
    """The pair's functions as `jit` compiles them.

    `select(c, a, b)` is a if c else b; `vec3` makes what `[0] [1] [2]` reads; `K` makes a constant of the working
    precision (a bare 2.0 would promote Numba's lanes to float64).
    """
    zero, one = K(0.0), K(1.0)
    u_min, alpha_max, t_min, neg_log2_e = K(U_MIN), K(ALPHA_MAX), K(T_MIN), K(-LOG2_E)

    @jit
    def half_slope(dx, dy, conic):
        """Half the gradient of r2 in the pixel's position; r2 itself is its product with (dx, dy)."""
        return conic[0] * dx + conic[1] * dy, conic[1] * dx + conic[2] * dy

    @jit
    def squared_distance(dx, dy, conic):
        """r2."""
        half_x, half_y = half_slope(dx, dy, conic)
        return dx * half_x + dy * half_y

    @jit
    def beta_falloff(r2):
        """(u, l) of the Beta kernel."""
        u = maximum(one - r2, u_min)
        return u, log2(u)

    @jit
    def gaussian_falloff(r2):
        """(u, l) of the Gaussian."""
        return one, neg_log2_e * r2

    @jit
    def coverage(r2, log_f, log2_opacity, exponent, r2_max):
        """Alpha, and the part of it that follows the shape (0 where capped)."""
        raw = exp2(log2_opacity + exponent * log_f)
        alpha = select(r2 < r2_max, minimum(raw, alpha_max), zero)
        return alpha, select(raw < alpha_max, alpha, zero)

    @jit
    def advance(T, alpha):
        """Weight of the pair and transmittance behind it. A pixel that has ended keeps its T with a minus sign."""
        weight = T * alpha
        behind = T - weight
        live = behind > t_min
        return select(live, weight, zero), select(live, behind, minimum(T, -T))

    @jit
    def transmittance(k, z):
        """e^{-beta z} per channel, for k = -beta log2(e)."""
        return vec3(exp2(k[0] * z), exp2(k[1] * z), exp2(k[2] * z))

    @jit
    def seen_color(color, Binf, E_B, E_D):
        """F: what a primitive adds to open water, per unit of weight."""
        return vec3(
            color[0] * E_D[0] - Binf[0] * E_B[0],
            color[1] * E_D[1] - Binf[1] * E_B[1],
            color[2] * E_D[2] - Binf[2] * E_B[2],
        )

    @jit
    def color_slope(g, g_clear, E_D):
        """dL/dc per unit of weight."""
        return vec3(g[0] * E_D[0] + g_clear[0], g[1] * E_D[1] + g_clear[1], g[2] * E_D[2] + g_clear[2])

    @jit
    def payloads(color, z, E_B, slope, g, g_veil, g_clear, g_z, g_alpha):
        """dL/dw: in full, of the geometry branch, of the depth branch. `g_veil` is dL/dI * B_inf."""
        depth = g_z * z
        both = depth + g_alpha
        geo = (g[0] + g_clear[0]) * color[0] + (g[1] + g_clear[1]) * color[1] + (g[2] + g_clear[2]) * color[2]
        image = slope[0] * color[0] + slope[1] * color[1] + slope[2] * color[2]
        veil = g_veil[0] * E_B[0] + g_veil[1] * E_B[1] + g_veil[2] * E_B[2]
        return image - veil + both, geo + both, depth

    @jit
    def shape_slopes(weight, T, alpha, shaped, u):
        """(p, q) with p e - q R = dL/dr2 / -b for a payload e and R behind it; zero where nothing is blended."""
        blended = select(weight > zero, shaped, zero)
        q = blended / ((one - alpha) * u)  # one division for 1 / (1 - alpha) and dalpha/dr2 = -b alpha / u
        return T * (q * (one - alpha)), q

    @jit
    def depth_slope(color, E_B, E_D, g, g_veil, k_b, k_d):
        """dL/dz through the water, per unit of weight, divided by ln 2."""
        direct = (
            k_d[0] * g[0] * color[0] * E_D[0] + k_d[1] * g[1] * color[1] * E_D[1] + k_d[2] * g[2] * color[2] * E_D[2]
        )
        veil = k_b[0] * g_veil[0] * E_B[0] + k_b[1] * g_veil[1] * E_B[1] + k_b[2] * g_veil[2] * E_B[2]
        return direct - veil

    return SimpleNamespace(
        half_slope=half_slope,
        squared_distance=squared_distance,
        beta_falloff=beta_falloff,
        gaussian_falloff=gaussian_falloff,
        coverage=coverage,
        advance=advance,
        transmittance=transmittance,
        seen_color=seen_color,
        color_slope=color_slope,
        payloads=payloads,
        shape_slopes=shape_slopes,
        depth_slope=depth_slope,
    )
