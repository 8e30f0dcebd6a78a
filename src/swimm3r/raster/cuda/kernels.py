"""The Warp kernels: one thread per pixel, one block of 256 threads per tile, compiled for each falloff.

A warp of 32 threads is 8 x 4 pixels. A primitive that touches none of them is skipped by a vote; the gradients
of the others are summed over the warp by a transposed butterfly (31 shuffles for up to 32 values) and added by one
coalesced atomic. No thread leaves a loop before its warp does, so pixels outside the image run along with T = -1. Float
atomics make the last bits of GPU gradients vary from run to run. The same source runs on the CPU, one thread after the
other, for tests.

Warp's own adjoint of a loop that carries T is wrong (docs/derivations/raster-kernels.md): ours is written by hand, and
its is switched off.
"""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, no_type_check

import warp as wp

from swimm3r.raster import pairmath
from swimm3r.raster.records import Kernel

VALUES = 20
"""Sums per primitive: mean 2, conic 3, color 3, opacity, beta, z through the water, z direct, geo 2, |geo| 2,
|full| 2, depth branch 2."""
LN_2, LOG2_E = wp.constant(pairmath.LN_2), wp.constant(pairmath.LOG2_E)
CHANNELS = {"conic", "color", "Binf", "E_B", "E_D", "slope", "g", "g_veil", "g_clear", "k", "k_b", "k_d"}


def _function(f: Callable[..., Any]) -> Any:
    """wp.func of a pair function: its colors and conics are vec3, all else is float."""
    f.__annotations__ = {name: wp.vec3 if name in CHANNELS else float for name in inspect.signature(f).parameters}
    return wp.func(f)


EXP2 = """
#if defined(__CUDA_ARCH__)
return exp2f(x);
#else
return wp::exp(x * 0.6931471805599453f);
#endif
"""
ANY = """
#if defined(__CUDA_ARCH__)
return __any_sync(0xffffffffu, x) ? 1 : 0;
#else
return x;
#endif
"""
ADD = """
const float values[20] = {v0, v1, v2, v3, v4, v5, v6, v7, v8, v9, v10, v11, v12, v13, v14, v15, v16, v17, v18, v19};
float* row = sums.data + 20 * primitive;
#if defined(__CUDA_ARCH__)
float v[32];
#pragma unroll
for (int i = 0; i < 32; ++i) v[i] = i < 20 ? values[i] : 0.0f;
const int lane = threadIdx.x & 31;
// constant bounds: a loop over `half` around this keeps v in local memory, as its trip counts are not known in time
#define HALVE(half) { \\
    const bool upper = (lane & half) != 0; \\
    _Pragma("unroll") \\
    for (int i = 0; i < half; ++i) { \\
        const float keep = upper ? v[i + half] : v[i]; \\
        const float give = upper ? v[i] : v[i + half]; \\
        v[i] = keep + __shfl_xor_sync(0xffffffffu, give, half); \\
    } \\
}
HALVE(16) HALVE(8) HALVE(4) HALVE(2) HALVE(1)
#undef HALVE
if (lane < 20) atomicAdd(row + lane, v[0]);
#else
for (int i = 0; i < 20; ++i) row[i] += values[i];
#endif
"""


@no_type_check  # on the outside: Warp reads a return type only where its own decorator stands alone
def _native_helpers() -> Any:
    """C++ that Warp has no words for. Their bodies must be `...`; on the CPU a "warp" is one thread.

    exp2: 2^x. warp_any: whether x holds on any of the warp's 32 threads; every thread must come there. add_over_warp:
    sums[primitive, k] += v_k over the warp; after the butterfly, lane k holds the warp's sum of value k.
    """

    @wp.func_native(EXP2)
    def exp2(x: float) -> float: ...

    @wp.func_native(ANY)
    def warp_any(x: int) -> int: ...

    @wp.func_native(ADD)
    def add_over_warp(
        sums: wp.array(dtype=float), primitive: int,
        v0: float, v1: float, v2: float, v3: float, v4: float, v5: float, v6: float, v7: float, v8: float, v9: float,
        v10: float, v11: float, v12: float, v13: float, v14: float, v15: float, v16: float, v17: float, v18: float,
        v19: float,
    ): ...  # fmt: skip

    return exp2, warp_any, add_over_warp


exp2, warp_any, add_over_warp = _native_helpers()
_pair = pairmath.make(_function, exp2, wp.log2, wp.min, wp.max, wp.where, wp.vec3, float)
half_slope, squared_distance, coverage = _pair.half_slope, _pair.squared_distance, _pair.coverage
advance, transmittance = _pair.advance, _pair.transmittance
seen_color, color_slope, payloads = _pair.seen_color, _pair.color_slope, _pair.payloads
shape_slopes, depth_slope = _pair.shape_slopes, _pair.depth_slope


@no_type_check
@wp.func
def pixel_of(tile: int, thread: int, columns: int):
    """(x, y) of a thread: eight warps of 8 x 4 pixels cover a tile."""
    block, lane = thread // 32, thread % 32
    return (tile % columns) * 16 + (block % 2) * 8 + lane % 8, (tile // columns) * 16 + (block // 2) * 4 + lane // 8


@no_type_check
@wp.func
def channels(image: wp.array3d(dtype=float), y: int, x: int):
    """The three channels of a pixel."""
    return wp.vec3(image[0, y, x], image[1, y, x], image[2, y, x])


@no_type_check
@wp.func
def store(image: wp.array3d(dtype=float), y: int, x: int, v: wp.vec3):
    """Write the three channels of a pixel."""
    image[0, y, x] = v[0]
    image[1, y, x] = v[1]
    image[2, y, x] = v[2]


@dataclass(frozen=True)
class PixelKernels:
    """The two passes for one falloff."""

    forward: Any
    adjoint: Any


@no_type_check
def _pixel_kernels(falloff: Any) -> PixelKernels:
    """The passes as compiled for one of the pair's falloffs."""

    @no_type_check
    @wp.kernel(enable_backward=False)
    def forward_kernel(
        packed: wp.array2d(dtype=float), tile_start: wp.array(dtype=int), ids: wp.array(dtype=int),
        Binf: wp.array3d(dtype=float), beta_D: wp.array3d(dtype=float), beta_B: wp.array3d(dtype=float),
        rgb: wp.array3d(dtype=float), clear: wp.array3d(dtype=float), z_depth: wp.array2d(dtype=float),
        alpha_out: wp.array2d(dtype=float),
    ):  # fmt: skip
        """Images, one thread per pixel."""
        tile, thread = wp.tid()
        height, width = z_depth.shape[0], z_depth.shape[1]
        pixel_x, pixel_y = pixel_of(tile, thread, (width + 15) // 16)
        inside = pixel_x < width and pixel_y < height
        x, y = wp.min(pixel_x, width - 1), wp.min(pixel_y, height - 1)
        center_x, center_y = float(x) + 0.5, float(y) + 0.5
        B, k_b, k_d = channels(Binf, y, x), -LOG2_E * channels(beta_B, y, x), -LOG2_E * channels(beta_D, y, x)
        T = wp.where(inside, 1.0, -1.0)
        image = wp.vec3(0.0, 0.0, 0.0)
        J = wp.vec3(0.0, 0.0, 0.0)
        D = wp.float32(0.0)
        entry = tile_start[tile]
        end = tile_start[tile + 1]
        while entry < end:
            i = ids[entry]
            entry += 1
            conic = wp.vec3(packed[i, 2], packed[i, 3], packed[i, 4])
            r2 = squared_distance(center_x - packed[i, 0], center_y - packed[i, 1], conic)
            _u, log_f = falloff(r2)
            alpha, _shaped = coverage(r2, log_f, packed[i, 5], packed[i, 6], packed[i, 7])
            if warp_any(wp.where(alpha > 0.0 and T > 0.0, 1, 0)) != 0:
                z = packed[i, 8]
                color = wp.vec3(packed[i, 9], packed[i, 10], packed[i, 11])
                w, behind = advance(T, alpha)
                T = behind
                image += w * seen_color(color, B, transmittance(k_b, z), transmittance(k_d, z))
                J += w * color
                D += w * z
                if warp_any(wp.where(T > 0.0, 1, 0)) == 0:
                    entry = end
        if inside:
            store(rgb, y, x, image + B)
            store(clear, y, x, J)
            z_depth[y, x] = D
            alpha_out[y, x] = 1.0 - wp.abs(T)

    @no_type_check
    @wp.kernel(enable_backward=False)
    def adjoint_kernel(
        packed: wp.array2d(dtype=float), tile_start: wp.array(dtype=int), ids: wp.array(dtype=int),
        Binf: wp.array3d(dtype=float), beta_D: wp.array3d(dtype=float), beta_B: wp.array3d(dtype=float),
        g_rgb: wp.array3d(dtype=float), g_clear: wp.array3d(dtype=float), g_z: wp.array2d(dtype=float),
        g_alpha: wp.array2d(dtype=float),
        rgb: wp.array3d(dtype=float), clear: wp.array3d(dtype=float), z_depth: wp.array2d(dtype=float),
        alpha_out: wp.array2d(dtype=float),
        sums: wp.array(dtype=float), d_Binf: wp.array3d(dtype=float), d_beta_D: wp.array3d(dtype=float),
        d_beta_B: wp.array3d(dtype=float),
    ):  # fmt: skip
        """Sums of every primitive and gradients of the water, front to back again (pairmath.py)."""
        tile, thread = wp.tid()
        height, width = z_depth.shape[0], z_depth.shape[1]
        pixel_x, pixel_y = pixel_of(tile, thread, (width + 15) // 16)
        inside = pixel_x < width and pixel_y < height
        x, y = wp.min(pixel_x, width - 1), wp.min(pixel_y, height - 1)
        center_x, center_y = float(x) + 0.5, float(y) + 0.5
        B, k_b, k_d = channels(Binf, y, x), -LOG2_E * channels(beta_B, y, x), -LOG2_E * channels(beta_D, y, x)
        g, gc = channels(g_rgb, y, x), channels(g_clear, y, x)
        gz, ga = g_z[y, x], g_alpha[y, x]
        g_veil = wp.cw_mul(g, B)
        J = channels(clear, y, x)
        rest_depth = gz * z_depth[y, x]
        both = rest_depth + ga * alpha_out[y, x] + wp.dot(gc, J)
        rest = wp.dot(g, channels(rgb, y, x) - B) + both
        rest_geo = wp.dot(g, J) + both
        T = wp.where(inside, 1.0, -1.0)
        veil = wp.vec3(0.0, 0.0, 0.0)
        z_veil = wp.vec3(0.0, 0.0, 0.0)
        z_direct = wp.vec3(0.0, 0.0, 0.0)
        entry = tile_start[tile]
        end = tile_start[tile + 1]
        while entry < end:
            i = ids[entry]
            entry += 1
            dx, dy = center_x - packed[i, 0], center_y - packed[i, 1]
            conic = wp.vec3(packed[i, 2], packed[i, 3], packed[i, 4])
            r2 = squared_distance(dx, dy, conic)
            u, log_f = falloff(r2)
            alpha, shaped = coverage(r2, log_f, packed[i, 5], packed[i, 6], packed[i, 7])
            if warp_any(wp.where(alpha > 0.0 and T > 0.0, 1, 0)) != 0:
                z = packed[i, 8]
                color = wp.vec3(packed[i, 9], packed[i, 10], packed[i, 11])
                w, behind = advance(T, alpha)
                p, q = shape_slopes(w, T, alpha, shaped, u)
                T = behind
                E_B, E_D = transmittance(k_b, z), transmittance(k_d, z)
                slope = color_slope(g, gc, E_D)
                full, geo, depth = payloads(color, z, E_B, slope, g, g_veil, gc, gz, ga)
                rest -= w * full
                rest_geo -= w * geo
                rest_depth -= w * depth
                veil += w * E_B
                z_veil += w * z * E_B
                z_direct += w * z * wp.cw_mul(color, E_D)
                t, t_geo, t_depth = p * full - q * rest, p * geo - q * rest_geo, p * depth - q * rest_depth
                half_x, half_y = half_slope(dx, dy, conic)
                add_over_warp(
                    sums, i, t * half_x, t * half_y, t * dx * dx, 2.0 * t * dx * dy, t * dy * dy,
                    w * slope[0], w * slope[1], w * slope[2], t * u, t * u * log_f,
                    w * depth_slope(color, E_B, E_D, g, g_veil, k_b, k_d), w * gz,
                    t_geo * half_x, t_geo * half_y, wp.abs(t_geo * half_x), wp.abs(t_geo * half_y),
                    wp.abs(t * half_x), wp.abs(t * half_y), t_depth * half_x, t_depth * half_y,
                )  # fmt: skip
                if warp_any(wp.where(T > 0.0, 1, 0)) == 0:
                    entry = end
        if inside:
            store(d_Binf, y, x, wp.cw_mul(g, wp.vec3(1.0, 1.0, 1.0) - veil))
            store(d_beta_B, y, x, wp.cw_mul(g_veil, z_veil))
            store(d_beta_D, y, x, -wp.cw_mul(g, z_direct))

    return PixelKernels(forward_kernel, adjoint_kernel)


PASSES: dict[Kernel, PixelKernels] = {
    "beta": _pixel_kernels(_pair.beta_falloff),
    "gaussian": _pixel_kernels(_pair.gaussian_falloff),
}
