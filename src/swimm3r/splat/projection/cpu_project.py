"""From stored primitives to the image plane and back in one pass on the CPU: `conditioning` and `projection` fused.

One kernel runs blocks of LANES primitives through a small workspace (`cpu_matrices`), forward, and, where gradients are
asked for, back again by the closed forms of docs/derivations/gradients.md; nothing per primitive is kept in between.
Only primitives with a gradient go back. The pose's is summed block by block, so that no result depends on the number of
threads.
"""

import zlib
from pathlib import Path
from typing import Any, TypeVar, no_type_check

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor

from swimm3r.raster import Primitives2D
from swimm3r.raster.cpu import math
from swimm3r.raster.cpu.threads import spread
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.projection import cpu_conditioning, cpu_fisheye, cpu_matrices, cpu_plane
from swimm3r.splat.projection.cpu_conditioning import (  # fmt: skip
    D_MEAN,
    D_WX,
    D_X,
    DIRECTION,
    DISTANCE,
    L11,
    Stored,
    W,
    condition,
    conditioning_gradients,
    load,
)
from swimm3r.splat.projection.cpu_matrices import LANES, SIZE_1, SIZE_3, SIZE_C, product_at, products, run, zero
from swimm3r.splat.projection.cpu_plane import (  # fmt: skip
    D_AT,
    POSE,
    RV,
    WORKSPACE,
    OnPlane,
    add_pose_gradients,
    along_view,
    center_gradient,
    hidden,
    onto_plane,
    plane_gradients,
    store_gradients,
    store_on_plane,
)
from swimm3r.splat.projection.pixel_filter import widening, with_light_kept
from swimm3r.splat.projection.view_camera import Projection, ViewCamera, ray_limits
from swimm3r.splat.settings import RenderSettings

# enters the kernels' signatures, so that Numba's cache notices when what is inlined into them changes
_INLINED = (cpu_conditioning, cpu_fisheye, cpu_matrices, cpu_plane, math)
SOURCES = zlib.crc32(b"".join(Path(str(module.__file__)).read_bytes() for module in _INLINED))
_D_CENTER = products(
    product_at(D_MEAN, RV, D_AT, SIZE_3, SIZE_3, SIZE_1),
    product_at(D_WX, L11, D_MEAN, SIZE_3, SIZE_3, SIZE_1),
    product_at(D_X, W, D_WX, SIZE_C, SIZE_3, SIZE_1),
)
kernel = njit(nogil=True, cache=True, error_model="numpy", fastmath=math.FLAGS)


@no_type_check
@kernel
def run_blocks(first, beyond, g, ids, back, stored, camera, lens, time, plane, gradients, d_pose, sources=SOURCES):
    """Blocks first..beyond-1 of `ids`. Forward fills `plane`; `back` reads its gradients there and fills the others."""
    three, c, two = stored.xyz.shape[1], stored.query_mean.shape[1], plane.mean2d.shape[1]
    for block in range(first, beyond):
        start = block * LANES
        count = min(LANES, len(ids) - start)
        load(g, ids, start, count, stored, camera, time)
        condition(g, three, c)
        onto_plane(g, camera, lens, three, two)
        if back:
            plane_gradients(g, ids, start, count, camera, lens, three, two, plane)
            conditioning_gradients(g, ids, start, count, three, c, plane.opacity, plane.exponent)
            add_pose_gradients(g, count, three, d_pose[block])
            store_gradients(g, ids, start, count, three, c, plane.opacity, gradients, d_pose[block])
        else:
            store_on_plane(g, ids, start, count, camera, lens, plane)


@no_type_check
@kernel
def center_blocks(first, beyond, g, ids, on_plane, stored, camera, lens, time, d_xyz, sources=SOURCES):
    """Blocks of `ids`: d_xyz [n, k, 3] of what on_plane [n, k, 3] says about centers and depths, k times over."""
    three, c, two = stored.xyz.shape[1], stored.query_mean.shape[1], on_plane.shape[2] - 1
    for block in range(first, beyond):
        start = block * LANES
        count = min(LANES, len(ids) - start)
        load(g, ids, start, count, stored, camera, time)
        condition(g, three, c)
        onto_plane(g, camera, lens, three, two)
        for k in range(on_plane.shape[1]):
            zero(g, D_AT, three, 1)
            for q in range(count):
                if hidden(g, q, camera, lens):
                    continue
                i = ids[start + q]
                center_gradient(g, q, camera, lens, on_plane[i, k, 0], on_plane[i, k, 1], on_plane[i, k, 2])
            run(g, _D_CENTER, two, three, c)
            for q in range(count):
                i, along = ids[start + q], along_view(g, q, three)
                for j in range(three):
                    across = (g[D_X, j, 0, q] - along * g[DIRECTION, j, 0, q]) / g[DISTANCE, 0, 0, q]
                    d_xyz[i, k, j] = g[D_MEAN, j, 0, q] + across


class _Project(torch.autograd.Function):
    """Saves its inputs only; the block is computed again on the way back, which costs less than its memory."""

    @staticmethod
    def forward(
        ctx: Any, view: ViewCamera, settings: RenderSettings, time: float, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        stored = Stored(*(tensor.detach().contiguous() for tensor in tensors[:-3]))
        camera, lens = _camera(view, settings), _lens(view)
        n = len(stored.xyz)
        out = OnPlane(*(torch.empty(shape) for shape in ((n, 2), (n, 3), (n,), (n,), (n,), (n,))))
        nothing = Stored(*(torch.empty(0, *values.shape[1:]) for values in stored))
        _run(np.arange(n), False, stored, camera, lens, time, out, nothing, torch.empty(0, POSE))
        ctx.save_for_backward(*stored)
        ctx.camera, ctx.lens, ctx.time = camera, lens, time
        ctx.mark_non_differentiable(out.radius)
        return tuple(out)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        d = OnPlane(*(v.contiguous() for v in cotangents[:5]), radius=torch.empty(0))
        given = torch.stack([v.flatten(1).any(-1) if v.ndim == 2 else v != 0 for v in d[:5]]).any(0)
        ids = given.nonzero()[:, 0].numpy()
        stored = Stored(*ctx.saved_tensors)
        results = Stored(*(torch.zeros_like(values) for values in stored))
        d_pose = torch.zeros(-(-len(ids) // LANES), POSE)
        _run(ids, True, stored, ctx.camera, ctx.lens, ctx.time, d, results, d_pose)
        pose = d_pose.double().sum(0).float()
        return None, None, None, *results[:-1], None, pose[:9].reshape(3, 3), pose[9:12], pose[12:]


def _camera(view: ViewCamera, settings: RenderSettings) -> np.ndarray:
    """The camera as the kernels read it."""
    pose = np.concatenate([t.detach().numpy().ravel() for t in (view.R, view.t, view.center)])
    lens = (view.fx, view.fy, view.cx, view.cy, *ray_limits(view))
    wider = widening(settings)
    rest = (*lens, settings.near, settings.covariance == "upper", *wider.world, *wider.plane)
    return np.concatenate([pose, np.array(rest)]).astype(np.float32)


def _lens(view: ViewCamera) -> np.ndarray | None:
    """The distortion of a fisheye; None of a pinhole."""
    return None if view.fisheye is None else np.array(view.fisheye)


def _run(
    ids: np.ndarray,
    back: bool,
    stored: Stored,
    camera: np.ndarray,
    lens: np.ndarray | None,
    time: float,
    plane: OnPlane,
    gradients: Stored,
    d_pose: Tensor,
) -> None:
    """The kernel over all blocks of `ids`, spread over threads."""
    primitives, seen, by_primitive = _arrays(stored), _arrays(plane), _arrays(gradients)
    pose, moment = d_pose.numpy(), np.float32(time)

    def work(first: int, beyond: int) -> None:
        g = np.zeros((WORKSPACE, 4, 4, LANES), np.float32)
        run_blocks(first, beyond, g, ids, back, primitives, camera, lens, moment, seen, by_primitive, pose)

    spread(work, -(-len(ids) // LANES), at_least=8)


Arrays = TypeVar("Arrays", Stored, OnPlane)


def _arrays(tensors: Arrays) -> Arrays:
    """The same record over the tensors' own memory, as the kernels read it."""
    return type(tensors)(*(tensor.detach().numpy() for tensor in tensors))


def project(
    p: BetaPrimitives, view: ViewCamera, settings: RenderSettings, time: Float[Tensor, ""] | None = None
) -> Projection:
    """`dispatch.project` for float32 on the CPU; no gradient reaches `time`."""
    moment = 0.0 if time is None else float(time)
    *plane, radius = _Project.apply(view, settings, moment, *_stored(p), view.R, view.t, view.center)
    mean2d, conic, opacity, exponent, depth = plane
    on_plane = Primitives2D(mean2d, conic, p.rgb, opacity, exponent, depth)
    return Projection(with_light_kept(on_plane, settings), radius)


def _stored(p: BetaPrimitives) -> Stored:
    return Stored(p.xyz, p.query_mean, p.opacity, p.beta, p.scale, p.lower, p.footprint)


def center_gradients(
    p: BetaPrimitives,
    view: ViewCamera,
    settings: RenderSettings,
    on_plane: Float[Tensor, "n k 3"],
    time: Float[Tensor, ""] | None = None,
) -> Float[Tensor, "n k 3"]:
    """`dispatch.center_gradients` for float32 on the CPU."""
    ids = on_plane.flatten(1).any(-1).nonzero()[:, 0].numpy()
    d_xyz = torch.zeros(*on_plane.shape[:2], 3)
    stored = _arrays(Stored(*(tensor.detach().contiguous() for tensor in _stored(p))))
    given, camera, lens = on_plane.detach().contiguous().numpy(), _camera(view, settings), _lens(view)
    moment, result = np.float32(0.0 if time is None else float(time)), d_xyz.numpy()

    def work(first: int, beyond: int) -> None:
        g = np.zeros((WORKSPACE, 4, 4, LANES), np.float32)
        center_blocks(first, beyond, g, ids, given, stored, camera, lens, moment, result)

    spread(work, -(-len(ids) // LANES), at_least=8)
    return d_xyz
