"""From stored primitives to the image plane and back in one pass on the CPU: `conditioning` and `projection` fused.

One kernel runs blocks of LANES primitives through a small workspace (`cpu_matrices`), forward, and, where gradients are
asked for, back again by the closed forms of docs/derivations/gradients.md; nothing per primitive is kept in between.
Only primitives with a gradient go back. The pose's is summed block by block, so that no result depends on the number of
threads.
"""

import zlib
from pathlib import Path
from typing import Any, no_type_check

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor

from swimm3r.raster import Primitives2D
from swimm3r.raster.cpu import math
from swimm3r.raster.cpu.threads import spread
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.projection import cpu_conditioning, cpu_matrices
from swimm3r.splat.projection.cpu_conditioning import (  # fmt: skip
    COV,
    D_B,
    D_COV,
    D_L11,
    D_L21,
    D_L22,
    D_MEAN,
    D_S,
    D_WX,
    D_X,
    DIRECTION,
    DISTANCE,
    L11,
    MATRICES,
    MEAN,
    OC,
    SLOPE,
    B,
    O,
    W,
    condition,
    conditioning_gradients,
    load,
)
from swimm3r.splat.projection.cpu_matrices import (
    HALF,
    LANES,
    ONE,
    SET,
    TWO,
    ZERO,
    product,
    product_at,
    product_bt,
    zero,
)
from swimm3r.splat.projection.pinhole import BLUR, Pinhole, Projection, ray_limits
from swimm3r.splat.settings import RenderSettings

# enters the kernel's signature, so that Numba's cache notices when what is inlined into it changes
SOURCES = zlib.crc32(b"".join(Path(str(m.__file__)).read_bytes() for m in (cpu_conditioning, cpu_matrices, math)))
kernel = njit(nogil=True, cache=True, error_model="numpy", fastmath=math.FLAGS)

LEAST_SPREAD = np.float32(0.01)
PX2 = np.float32(BLUR)
POSE = 15  # gradient of R (9), t (3), center (3)
(FX, FY, CX, CY, X_LOW, X_HIGH, Y_LOW, Y_HIGH, NEAR, UPPER) = range(15, 25)  # of the camera array, after R, t, center
# matrices after those of conditioning
AT, J, RV, COV_SEEN, M, M_COV, PLANE, D_AT, D_M, D_J, D_PLANE, OUTER = range(MATRICES, MATRICES + 12)


@no_type_check
@math.inlined
def onto_plane(g, camera, three, two):
    """AT in camera axes and PLANE, the covariance on the image plane with its blur."""
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
    for axis in range(two):
        f, low, high = camera[FX + axis], camera[X_LOW + 2 * axis], camera[X_HIGH + 2 * axis]
        at, z, straight, slant = g[AT, axis, 0], g[AT, 2, 0], g[J, axis, axis], g[J, axis, 2]
        for q in range(g.shape[3]):
            inverse = ONE / max(z[q], camera[NEAR])
            straight[q] = f * inverse
            slant[q] = -f * inverse * min(max(at[q] * inverse, low), high)
    product(g, M, J, RV, two, three, three, ONE, SET)
    product(g, M_COV, M, COV_SEEN, two, three, three, ONE, SET)
    product_bt(g, PLANE, M_COV, M, two, three, two, ONE, SET)
    for axis in range(two):
        variance = g[PLANE, axis, axis]
        for q in range(g.shape[3]):
            variance[q] += PX2


@no_type_check
@math.inlined
def plane_gradients(g, ids, start, count, camera, three, two, d_mean2d, d_conic, d_depth):
    """D_AT, D_M, D_COV and D_MEAN of centers, conics and depths (docs/derivations/gradients.md#projection)."""
    zero(g, D_AT, three, 1)
    zero(g, D_PLANE, two, two)
    fx, fy = camera[FX], camera[FY]
    for q in range(count):
        i = ids[start + q]
        x, y, z = g[AT, 0, 0, q], g[AT, 1, 0, q], g[AT, 2, 0, q]
        a, b, c = g[PLANE, 0, 0, q], g[PLANE, 0, 1, q], g[PLANE, 1, 1, q]
        det = a * c - b * b
        if z <= camera[NEAR] or det <= ZERO:
            continue
        u, v = d_mean2d[i, 0], d_mean2d[i, 1]
        g[D_AT, 0, 0, q], g[D_AT, 1, 0, q] = fx / z * u, fy / z * v
        g[D_AT, 2, 0, q] = d_depth[i] - (fx * x * u + fy * y * v) / (z * z)
        xx, xy, yy = c / det, -b / det, a / det
        g00, g01, g11 = d_conic[i, 0], HALF * d_conic[i, 1], d_conic[i, 2]
        r00, r01, r10, r11 = g00 * xx + g01 * xy, g00 * xy + g01 * yy, g01 * xx + g11 * xy, g01 * xy + g11 * yy
        g[D_PLANE, 0, 0, q], g[D_PLANE, 0, 1, q] = -(xx * r00 + xy * r10), -(xx * r01 + xy * r11)
        g[D_PLANE, 1, 0, q], g[D_PLANE, 1, 1, q] = g[D_PLANE, 0, 1, q], -(xy * r01 + yy * r11)
    product(g, D_M, D_PLANE, M_COV, two, two, three, TWO, SET)
    product_bt(g, D_J, D_M, RV, two, three, three, ONE, SET)
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
    product_at(g, OUTER, M, D_PLANE, three, two, two, ONE, SET)
    product(g, D_COV, OUTER, M, three, two, three, ONE, SET)
    if camera[UPPER] > ZERO:
        for i in range(three):
            for j in range(i):
                for q in range(g.shape[3]):
                    g[D_COV, j, i, q] += g[D_COV, i, j, q]
                    g[D_COV, i, j, q] = ZERO
    product_at(g, D_MEAN, RV, D_AT, three, three, 1, ONE, SET)


@no_type_check
@math.inlined
def along_view(g, q, three):
    """The part of D_X along lane q's view direction, which a unit vector does not follow."""
    along = ZERO
    for k in range(three):
        along += g[D_X, k, 0, q] * g[DIRECTION, k, 0, q]
    return along


@no_type_check
@kernel
def run_blocks(
    first, beyond, g, ids, back, xyz, query_mean, opacity, beta, scale, lower, camera, time,
    mean2d, conic, seen_opacity, exponent, depth, radius,
    d_xyz, d_query, d_opacity, d_beta, d_scale, d_lower, d_pose, sources=SOURCES,
):  # fmt: skip
    """Blocks first..beyond-1 of `ids`. Forward fills mean2d ... radius; `back` reads their gradients there instead."""
    three, c, two = xyz.shape[1], query_mean.shape[1], mean2d.shape[1]
    for block in range(first, beyond):
        start = block * LANES
        count = min(LANES, len(ids) - start)
        load(g, ids, start, count, xyz, query_mean, opacity, beta, scale, lower, camera, time)
        condition(g, three, c)
        onto_plane(g, camera, three, two)
        if not back:
            for q in range(count):
                i = ids[start + q]
                x, y, z = g[AT, 0, 0, q], g[AT, 1, 0, q], g[AT, 2, 0, q]
                xx, xy, yy = g[PLANE, 0, 0, q], g[PLANE, 0, 1, q], g[PLANE, 1, 1, q]
                det = xx * yy - xy * xy
                seen_opacity[i], exponent[i] = g[OC, 0, 0, q], g[B, 0, 0, q]
                if z <= camera[NEAR] or det <= ZERO:
                    mean2d[i, 0], mean2d[i, 1], depth[i], radius[i] = ZERO, ZERO, ZERO, ZERO
                    conic[i, 0], conic[i, 1], conic[i, 2] = ONE, ZERO, ONE
                    continue
                mean2d[i, 0], mean2d[i, 1] = camera[FX] * x / z + camera[CX], camera[FY] * y / z + camera[CY]
                conic[i, 0], conic[i, 1], conic[i, 2] = yy / det, -xy / det, xx / det
                middle = HALF * (xx + yy)
                depth[i] = z
                radius[i] = np.sqrt(middle + np.sqrt(max(middle * middle - det, LEAST_SPREAD)))
            continue
        plane_gradients(g, ids, start, count, camera, three, two, mean2d, conic, depth)
        conditioning_gradients(g, ids, start, count, three, c, seen_opacity, exponent)
        pose = d_pose[block]
        for i in range(three):
            for j in range(three):
                for q in range(count):
                    pose[3 * i + j] += g[D_AT, i, 0, q] * g[MEAN, j, 0, q]
                    pose[3 * i + j] += g[J, 0, i, q] * g[D_M, 0, j, q] + g[J, 1, i, q] * g[D_M, 1, j, q]
            for q in range(count):
                pose[9 + i] += g[D_AT, i, 0, q]
        for q in range(count):
            i, along = ids[start + q], along_view(g, q, three)
            for k in range(three):
                across = (g[D_X, k, 0, q] - along * g[DIRECTION, k, 0, q]) / g[DISTANCE, 0, 0, q]
                d_xyz[i, k] = g[D_MEAN, k, 0, q] + across
                pose[12 + k] -= across
                d_scale[i, k] = g[D_S, 0, k, q] * g[SLOPE, 0, k, q]
            d_opacity[i] = seen_opacity[i] * g[OC, 0, 0, q] * (ONE - g[O, 0, 0, q])
            d_beta[i, 0] = g[D_B, 0, 0, q] * g[B, 0, 0, q]
            d_lower[i, 0] = g[D_L11, 0, 1, q] - g[D_L11, 1, 0, q]
            d_lower[i, 1] = g[D_L11, 0, 2, q] - g[D_L11, 2, 0, q]
            d_lower[i, 2] = g[D_L11, 1, 2, q] - g[D_L11, 2, 1, q]
            entry = 3
            for r in range(c):
                d_query[i, r] = -g[D_X, r, 0, q]
                d_beta[i, 1 + r] = g[D_B, 1, r, q] * g[B, 1, r, q]
                d_scale[i, 3 + r] = g[D_L22, r, r, q] * g[SLOPE, 1, r, q]
                for k in range(three):
                    d_lower[i, entry + k] = g[D_L21, r, k, q]
                for k in range(r):
                    d_lower[i, entry + 3 + k] = g[D_L22, r, k, q]
                entry += 3 + r


@no_type_check
@kernel
def center_blocks(
    first, beyond, g, ids, on_plane, xyz, query_mean, opacity, beta, scale, lower, camera, time, d_xyz, sources=SOURCES
):  # fmt: skip
    """Blocks of `ids`: d_xyz [n, k, 3] of what on_plane [n, k, 3] says about centers and depths, k times over."""
    three, c, two = xyz.shape[1], query_mean.shape[1], on_plane.shape[2] - 1
    fx, fy = camera[FX], camera[FY]
    for block in range(first, beyond):
        start = block * LANES
        count = min(LANES, len(ids) - start)
        load(g, ids, start, count, xyz, query_mean, opacity, beta, scale, lower, camera, time)
        condition(g, three, c)
        onto_plane(g, camera, three, two)
        for k in range(on_plane.shape[1]):
            zero(g, D_AT, three, 1)
            for q in range(count):
                i = ids[start + q]
                x, y, z = g[AT, 0, 0, q], g[AT, 1, 0, q], g[AT, 2, 0, q]
                if z <= camera[NEAR]:
                    continue
                u, v = on_plane[i, k, 0], on_plane[i, k, 1]
                g[D_AT, 0, 0, q], g[D_AT, 1, 0, q] = fx / z * u, fy / z * v
                g[D_AT, 2, 0, q] = on_plane[i, k, 2] - (fx * x * u + fy * y * v) / (z * z)
            product_at(g, D_MEAN, RV, D_AT, three, three, 1, ONE, SET)
            product_at(g, D_WX, L11, D_MEAN, three, three, 1, ONE, SET)
            product_at(g, D_X, W, D_WX, c, three, 1, ONE, SET)
            for q in range(count):
                i, along = ids[start + q], along_view(g, q, three)
                for j in range(three):
                    across = (g[D_X, j, 0, q] - along * g[DIRECTION, j, 0, q]) / g[DISTANCE, 0, 0, q]
                    d_xyz[i, k, j] = g[D_MEAN, j, 0, q] + across


class _Project(torch.autograd.Function):
    """Saves its inputs only; the block is computed again on the way back, which costs less than its memory."""

    @staticmethod
    def forward(ctx: Any, view: Pinhole, settings: RenderSettings, time: float, *tensors: Tensor) -> tuple[Tensor, ...]:
        stored = [tensor.detach().contiguous() for tensor in tensors[:-3]]
        camera = _camera(view, settings)
        n = len(stored[0])
        out = tuple(torch.empty(shape) for shape in ((n, 2), (n, 3), (n,), (n,), (n,), (n,)))
        nothing = [torch.empty(0, *values.shape[1:]) for values in stored]
        _run(np.arange(n), False, stored, camera, time, out, [*nothing, torch.empty(0, POSE)])
        ctx.save_for_backward(*stored)
        ctx.camera, ctx.time = camera, time
        ctx.mark_non_differentiable(out[-1])
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        d = [v.contiguous() for v in cotangents[:5]]
        given = torch.stack([v.flatten(1).any(-1) if v.ndim == 2 else v != 0 for v in d]).any(0)
        ids = given.nonzero()[:, 0].numpy()
        results = [torch.zeros_like(values) for values in ctx.saved_tensors]
        d_pose = torch.zeros(-(-len(ids) // LANES), POSE)
        radius = torch.empty(0)
        _run(ids, True, ctx.saved_tensors, ctx.camera, ctx.time, [*d, radius], [*results, d_pose])
        pose = d_pose.double().sum(0).float()
        return None, None, None, *results, pose[:9].reshape(3, 3), pose[9:12], pose[12:]


def _camera(view: Pinhole, settings: RenderSettings) -> np.ndarray:
    """The camera as the kernels read it."""
    pose = np.concatenate([t.detach().numpy().ravel() for t in (view.R, view.t, view.center)])
    rest = (view.fx, view.fy, view.cx, view.cy, *ray_limits(view), settings.near, settings.covariance == "upper")
    return np.concatenate([pose, np.array(rest)]).astype(np.float32)


def _run(ids: np.ndarray, back: bool, stored: Any, camera: np.ndarray, time: float, plane: Any, gradients: Any) -> None:
    """The kernel over all blocks of `ids`, on as many threads as torch uses."""
    arguments: Any = (ids, back, *(t.numpy() for t in stored), camera, np.float32(time))
    rest: Any = tuple(t.numpy() for t in (*plane, *gradients))

    def work(first: int, beyond: int) -> None:
        workspace = np.zeros((OUTER + 1, 4, 4, LANES), np.float32)
        run_blocks(first, beyond, workspace, *arguments, *rest)

    spread(work, -(-len(ids) // LANES), at_least=8)


def project(
    p: BetaPrimitives, view: Pinhole, settings: RenderSettings, time: Float[Tensor, ""] | None = None
) -> Projection:
    """`dispatch.project` for float32 on the CPU; no gradient reaches `time`."""
    moment = 0.0 if time is None else float(time)
    *plane, radius = _Project.apply(
        view, settings, moment, p.xyz, p.query_mean, p.opacity, p.beta, p.scale, p.lower, view.R, view.t, view.center
    )
    mean2d, conic, opacity, exponent, depth = plane
    return Projection(Primitives2D(mean2d, conic, p.rgb, opacity, exponent, depth), radius)


def center_gradients(
    p: BetaPrimitives,
    view: Pinhole,
    settings: RenderSettings,
    on_plane: Float[Tensor, "n k 3"],
    time: Float[Tensor, ""] | None = None,
) -> Float[Tensor, "n k 3"]:
    """`dispatch.center_gradients` for float32 on the CPU."""
    ids = on_plane.flatten(1).any(-1).nonzero()[:, 0].numpy()
    d_xyz = torch.zeros(*on_plane.shape[:2], 3)
    stored = (p.xyz, p.query_mean, p.opacity, p.beta, p.scale, p.lower)
    arrays: Any = (ids, *(t.detach().contiguous().numpy() for t in (on_plane, *stored)), _camera(view, settings))
    rest: Any = (np.float32(0.0 if time is None else float(time)), d_xyz.numpy())

    def work(first: int, beyond: int) -> None:
        workspace = np.zeros((OUTER + 1, 4, 4, LANES), np.float32)
        center_blocks(first, beyond, workspace, *arrays, *rest)

    spread(work, -(-len(ids) // LANES), at_least=8)
    return d_xyz
