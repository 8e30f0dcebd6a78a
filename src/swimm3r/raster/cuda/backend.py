"""The CUDA back end: NVIDIA Warp kernels with one thread per pixel and one block of 256 threads per tile.

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
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, no_type_check

import torch
import warp as wp
from torch import Tensor

from swimm3r.raster import pairmath
from swimm3r.raster.records import TILE, Bins, Kernel, MediumMaps, Primitives2D, RasterOutput, SggBuffers

# No banner, no "module loaded" lines: they would land in the middle of the command line's progress. The first name is
# Warp's before 1.19, the second since.
setattr(wp.config, "quiet", True)  # noqa: B010
wp.config.log_level = 30
wp.init()

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


_PASSES: dict[Kernel, PixelKernels] = {
    "beta": _pixel_kernels(_pair.beta_falloff),
    "gaussian": _pixel_kernels(_pair.gaussian_falloff),
}


def bin_primitives(p: Primitives2D, height: int, width: int, alpha_min: float, kernel: Kernel) -> Bins:
    """Tile lists on the primitives' device, exact as on the CPU.

    The host waits twice: for the number of tiles around the primitives, and for that of those they touch.
    """
    n, device = len(p.depth), p.depth.device
    A, B, C = p.conic.double().unbind(-1)
    determinant = A * C - B * B
    if kernel == "gaussian":
        r2_max = (p.opacity.double() / alpha_min).log() / p.beta.double()
    else:
        r2_max = 1 - (alpha_min / p.opacity.double()) ** (1 / p.beta.double())
    seen = (p.depth > 0) & p.depth.isfinite() & p.mean2d.isfinite().all(-1) & (A > 0) & (determinant > 0)
    seen &= A.isfinite() & determinant.isfinite() & (p.beta > 0) & (p.opacity > 0) & (p.opacity >= alpha_min)
    safe = torch.where(seen, determinant, 1.0)
    half = torch.stack([r2_max * C / safe, r2_max * A / safe], -1).clamp(min=0).sqrt() + 1e-3
    size = torch.tensor([width, height]).to(device)
    mean = torch.where(seen[:, None], p.mean2d.double(), 0.0)
    first = (mean - half - 0.5).ceil().clamp(min=0).minimum(size).nan_to_num(0).long()
    last = (mean + half - 0.5).floor().clamp(min=-1).minimum(size - 1).nan_to_num(-1).long()
    first_tile, last_tile = first // TILE, torch.div(last, TILE, rounding_mode="floor")
    counts = (last_tile - first_tile + 1).clamp(min=0).prod(-1) * (seen & (first <= last).all(-1))
    ids = torch.repeat_interleave(torch.arange(n, device=device), counts)
    within = torch.arange(len(ids), device=device) - (counts.cumsum(0) - counts)[ids]
    wide = (last_tile - first_tile + 1)[ids, 0]
    column, row = first_tile[ids, 0] + within % wide, first_tile[ids, 1] + within // wide
    # the interval of x that the ellipse covers in the tile's rows (bins.span)
    a, b, d = A[ids], B[ids], determinant[ids]
    low_y = torch.maximum(row * TILE, first[ids, 1]) + 0.5 - mean[ids, 1]
    high_y = torch.minimum(row * TILE + TILE - 1, last[ids, 1]) + 0.5 - mean[ids, 1]
    offset = -b * half[ids, 0] / C[ids]
    reach = a * r2_max[ids]
    y = offset.clamp(low_y, high_y)
    right = mean[ids, 0] + (-b * y + (reach - d * y * y).clamp(min=0).sqrt()) / a + 1e-3
    y = (-offset).clamp(low_y, high_y)
    left = mean[ids, 0] + (-b * y - (reach - d * y * y).clamp(min=0).sqrt()) / a - 1e-3
    kept = ((left <= column * TILE + TILE - 0.5) & (right >= column * TILE + 0.5)).nonzero()[:, 0]
    ids, tile = ids[kept], (row * ((width + TILE - 1) // TILE) + column)[kept]
    key = (tile << 32) | p.depth.float().view(torch.int32)[
        ids
    ].long()  # the bits of positive floats sort like the floats
    order = torch.argsort(key, stable=True)
    tiles = ((height + TILE - 1) // TILE) * ((width + TILE - 1) // TILE)
    tile_start = torch.searchsorted(tile[order], torch.arange(tiles + 1, device=device)).int()
    record = torch.zeros(n, 16, device=device)
    record[:, :2], record[:, 2:5], record[:, 5] = p.mean2d, p.conic, p.opacity.log2()
    record[:, 6], record[:, 7], record[:, 8], record[:, 9:12] = p.beta, r2_max, p.depth, p.color
    return Bins(height, width, alpha_min, kernel, record, tile_start, ids[order].int())


def forward(bins: Bins, p: Primitives2D, medium: MediumMaps) -> RasterOutput:
    """The four images."""
    like, height, width = medium.Binf, bins.height, bins.width
    shapes = ((3, height, width), (3, height, width), (height, width), (height, width))
    out = RasterOutput(*(like.new_empty(shape) for shape in shapes))
    _launch(_PASSES[bins.kernel].forward, bins, [bins.packed, bins.tile_start, bins.ids, *medium, *out])
    return out


def backward(
    bins: Bins,
    p: Primitives2D,
    medium: MediumMaps,
    out: RasterOutput,
    cotangent: RasterOutput,
    sgg: SggBuffers | None,
    with_medium: bool,
) -> tuple[Primitives2D, MediumMaps | None]:
    """Gradients of the primitives and, where wanted, of the medium maps; adds to `sgg`."""
    sums = bins.packed.new_zeros(len(p.depth) * VALUES)
    d_medium = MediumMaps(*(torch.empty_like(t) for t in medium))
    images = (*medium, *(g.contiguous() for g in cotangent), *out)
    _launch(_PASSES[bins.kernel].adjoint, bins, [bins.packed, bins.tile_start, bins.ids, *images, sums, *d_medium])
    s = sums.view(-1, VALUES)
    exponent = torch.where(s.any(-1), p.beta, 1.0)[:, None]  # what was not seen may hold anything
    opacity = torch.where(s.any(-1), p.opacity, 1.0)
    grads = Primitives2D(
        2 * exponent * s[:, 0:2],
        -exponent * s[:, 2:5],
        s[:, 5:8].contiguous(),
        s[:, 8] / opacity,
        pairmath.LN_2 * s[:, 9],
        pairmath.LN_2 * s[:, 10] + s[:, 11],
    )
    if sgg is not None:
        geo, geo_abs, full_abs, depth = (2 * exponent * s[:, k : k + 2] for k in (12, 14, 16, 18))
        iso = torch.cat([depth, s[:, 11:12]], -1)
        for buffer, part in zip(sgg, (geo, grads.mean2d - geo, geo_abs, full_abs, iso), strict=True):
            buffer += part
    return grads, d_medium if with_medium else None


def _launch(kernel: Any, bins: Bins, tensors: list[Tensor]) -> None:
    """One thread per pixel of every tile, on torch's current stream."""
    rows, columns = bins.tiles()
    device = tensors[0].device
    on_stream: AbstractContextManager[Any] = nullcontext()
    if device.type == "cuda":
        on_stream = wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device)), sync_enter=False)
    with on_stream:
        arrays = [wp.from_torch(t.detach(), requires_grad=False) for t in tensors]
        wp.launch(
            kernel, dim=(rows * columns, TILE * TILE), inputs=arrays, device=wp.device_from_torch(device),
            block_dim=TILE * TILE,
        )  # fmt: skip
