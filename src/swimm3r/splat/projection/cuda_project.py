"""From stored primitives to the image plane and back in one pass on a GPU: `conditioning` and `plain` as a Warp kernel.

One thread per primitive. The adjoint is Warp's own: the code has no loop and writes no value twice. A map of D = 6 is
treated as one of D = 7 whose last dimension is independent of the others and met at its mean, which changes nothing.
"""

import math
from collections.abc import Sequence
from typing import Any, no_type_check

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from swimm3r.raster import Primitives2D
from swimm3r.raster.cuda.launch import torch_stream
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.projection.pixel_filter import widening, with_light_kept
from swimm3r.splat.projection.view_camera import Projection, ViewCamera, ray_limits
from swimm3r.splat.settings import RenderSettings

_COPIES = 256
"""Copies of the pose that the threads read in turn: to add every thread's gradient to one address would take long."""
_BLOCK = 128  # threads: the adjoint holds more than a hundred numbers
LN_2 = wp.constant(math.log(2))
LEAST_SPREAD = wp.constant(0.01)
LEAST_RHO2 = wp.constant(wp.float64(1e-12))


class _Lens:
    """The camera but for its pose, and the settings of the projection."""

    f: wp.vec2
    c: wp.vec2
    lowest: wp.vec2  # x / z and y / z between which J is taken
    highest: wp.vec2
    near: float
    upper: int  # whether the upper triangle of a covariance counts, instead of its symmetric part
    world: wp.vec2  # `pixel_filter.Widening`
    plane: wp.vec2
    k: wp.vec4d  # of a fisheye


Lens: Any = wp.struct(_Lens)


@no_type_check
@wp.func
def log1p(e: float):
    """ln(1 + e) of 0 <= e <= 1 without cancellation (Kahan)."""
    u = 1.0 + e
    return wp.where(u == 1.0, e, wp.log(u) * (e / (u - 1.0 + wp.where(u == 1.0, 1.0, 0.0))))


@no_type_check
@wp.func
def softplus(x: float):
    """ln(1 + e^x)."""
    return wp.max(x, 0.0) + log1p(wp.exp(-wp.abs(x)))


@no_type_check
@wp.func_grad(softplus)
def adjoint_softplus(x: float, adj_ret: float):
    """d softplus = sigmoid."""
    wp.adjoint[x] += adj_ret / (1.0 + wp.exp(-x))


@no_type_check
@wp.func
def log_share(y: float):
    """ln(1 - tanh y^2) = ln 2 - softplus(2 y^2)."""
    return LN_2 - 2.0 * y * y - log1p(wp.exp(-2.0 * y * y))


@no_type_check
@wp.func_grad(log_share)
def adjoint_log_share(y: float, adj_ret: float):
    """d ln(1 - tanh y^2) / dy = -2 y (1 + tanh y^2)."""
    wp.adjoint[y] += -2.0 * y * (1.0 + wp.tanh(y * y)) * adj_ret


@no_type_check
@wp.func
def exponent(stored: float):
    """B = 4 e^stored, kept finite."""
    return 4.0 * wp.exp(wp.min(stored, 20.0))


@no_type_check
@wp.func
def through_pinhole(p: wp.vec3, lens: Lens):
    """Pixel of a point in camera axes, the rows of its Jacobian, and whether the lens images it."""
    z = p[2]
    sx = wp.clamp(p[0] / z, lens.lowest[0], lens.highest[0])
    sy = wp.clamp(p[1] / z, lens.lowest[1], lens.highest[1])
    pixel = wp.vec2(lens.f[0] * p[0] / z + lens.c[0], lens.f[1] * p[1] / z + lens.c[1])
    row_x = wp.vec3(lens.f[0] / z, 0.0, -lens.f[0] * sx / z)
    row_y = wp.vec3(0.0, lens.f[1] / z, -lens.f[1] * sy / z)
    return pixel, row_x, row_y, True


@no_type_check
@wp.func
def through_fisheye(p: wp.vec3, lens: Lens):
    """The same of a fisheye, in float64: near the axis its Jacobian is a difference of nearly equal numbers."""
    x, y, z = wp.float64(p[0]), wp.float64(p[1]), wp.float64(p[2])
    fx, fy = wp.float64(lens.f[0]), wp.float64(lens.f[1])
    one, k = wp.float64(1.0), lens.k
    rho2 = wp.max(x * x + y * y, LEAST_RHO2)
    distance2, rho = rho2 + z * z, wp.sqrt(rho2)
    theta = wp.atan2(rho, z)
    t2 = theta * theta
    a = theta * (one + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))) / rho
    slope = one + t2 * (
        wp.float64(3.0) * k[0]
        + t2 * (wp.float64(5.0) * k[1] + t2 * (wp.float64(7.0) * k[2] + t2 * wp.float64(9.0) * k[3]))
    )
    radial = (slope * z / distance2 - a) / rho2
    mixed, ahead = x * y * radial, -slope / distance2
    pixel = wp.vec2(float(fx * x * a) + lens.c[0], float(fy * y * a) + lens.c[1])
    row_x = wp.vec3(float(fx * (a + x * x * radial)), float(fx * mixed), float(fx * x * ahead))
    row_y = wp.vec3(float(fy * mixed), float(fy * (a + y * y * radial)), float(fy * y * ahead))
    return pixel, row_x, row_y, slope > wp.float64(0.0)


@no_type_check
def _kernel(through: Any) -> Any:
    """The kernel as compiled for one kind of lens."""

    @no_type_check
    @wp.kernel
    def project_kernel(
        xyz: wp.array(dtype=wp.vec3), query_mean: wp.array2d(dtype=float), stored_opacity: wp.array(dtype=float),
        beta: wp.array2d(dtype=float), scale: wp.array2d(dtype=float), lower: wp.array2d(dtype=float),
        footprint: wp.array(dtype=float), rotation: wp.array(dtype=wp.mat33), shift: wp.array(dtype=wp.vec3),
        center: wp.array(dtype=wp.vec3), moment: wp.array(dtype=float), lens: Lens,
        mean2d: wp.array(dtype=wp.vec2), conic: wp.array(dtype=wp.vec3), opacity: wp.array(dtype=float),
        kernel_exponent: wp.array(dtype=float), depth: wp.array(dtype=float), radius: wp.array(dtype=float),
    ):  # fmt: skip
        """One primitive."""
        i = wp.tid()
        pose = i % rotation.shape[0]
        at, R = xyz[i], rotation[pose]
        direction = wp.normalize(at - center[pose])

        # the factor of the covariance: L11, the rows u of L21, L22, and the query's offset x
        s = wp.vec3(softplus(scale[i, 0]), softplus(scale[i, 1]), softplus(scale[i, 2]))
        a01, a02, a12 = lower[i, 0], lower[i, 1], lower[i, 2]
        L11 = wp.mat33(s[0], a01 * s[1], a02 * s[2], -a01 * s[0], s[1], a12 * s[2], -a02 * s[0], -a12 * s[1], s[2])
        u0 = wp.vec3(lower[i, 3], lower[i, 4], lower[i, 5])
        u1 = wp.vec3(lower[i, 6], lower[i, 7], lower[i, 8])
        u2 = wp.vec3(lower[i, 10], lower[i, 11], lower[i, 12])
        c00, c11, c22 = softplus(scale[i, 3]), softplus(scale[i, 4]), softplus(scale[i, 5])
        c10, c20, c21 = lower[i, 9], lower[i, 13], lower[i, 14]
        x0, x1, x2 = direction[0] - query_mean[i, 0], direction[1] - query_mean[i, 1], direction[2] - query_mean[i, 2]
        B0, B1, B2 = exponent(beta[i, 1]), exponent(beta[i, 2]), exponent(beta[i, 3])
        u3 = wp.vec3(0.0, 0.0, 0.0)
        c30, c31, c32, c33 = wp.float32(0.0), wp.float32(0.0), wp.float32(0.0), wp.float32(1.0)
        x3, B3 = wp.float32(0.0), wp.float32(0.0)
        if query_mean.shape[1] == 4:
            u3 = wp.vec3(lower[i, 15], lower[i, 16], lower[i, 17])
            c30 = lower[i, 18]
            c31 = lower[i, 19]
            c32 = lower[i, 20]
            c33 = softplus(scale[i, 6])
            x3 = moment[0] - query_mean[i, 3]
            B3 = exponent(beta[i, 4])

        # V22 = L21 L21^T + L22 L22^T = Lc Lc^T
        v00 = wp.dot(u0, u0) + c00 * c00
        v10 = wp.dot(u1, u0) + c10 * c00
        v20 = wp.dot(u2, u0) + c20 * c00
        v30 = wp.dot(u3, u0) + c30 * c00
        v11 = wp.dot(u1, u1) + c10 * c10 + c11 * c11
        v21 = wp.dot(u2, u1) + c20 * c10 + c21 * c11
        v31 = wp.dot(u3, u1) + c30 * c10 + c31 * c11
        v22 = wp.dot(u2, u2) + c20 * c20 + c21 * c21 + c22 * c22
        v32 = wp.dot(u3, u2) + c30 * c20 + c31 * c21 + c32 * c22
        v33 = wp.dot(u3, u3) + c30 * c30 + c31 * c31 + c32 * c32 + c33 * c33
        l00 = wp.sqrt(v00)
        l10, l20, l30 = v10 / l00, v20 / l00, v30 / l00
        l11 = wp.sqrt(v11 - l10 * l10)
        l21, l31 = (v21 - l20 * l10) / l11, (v31 - l30 * l10) / l11
        l22 = wp.sqrt(v22 - l20 * l20 - l21 * l21)
        l32 = (v32 - l30 * l20 - l31 * l21) / l22
        l33 = wp.sqrt(v33 - l30 * l30 - l31 * l31 - l32 * l32)

        # the rows q of V22^-1 L21, weighed: G = L11 [q0 q1 q2 q3]
        h0 = u0 / l00
        h1 = (u1 - l10 * h0) / l11
        h2 = (u2 - l20 * h0 - l21 * h1) / l22
        h3 = (u3 - l30 * h0 - l31 * h1 - l32 * h2) / l33
        g3 = h3 / l33
        g2 = (h2 - l32 * g3) / l22
        g1 = (h1 - l21 * g2 - l31 * g3) / l11
        g0 = (h0 - l10 * g1 - l20 * g2 - l30 * g3) / l00
        q0, q1 = wp.min(0.25 * B0, 1.0) * g0, wp.min(0.25 * B1, 1.0) * g1
        q2, q3 = wp.min(0.25 * B2, 1.0) * g2, wp.min(0.25 * B3, 1.0) * g3
        mean = at + L11 * (x0 * q0 + x1 * q1 + x2 * q2 + x3 * q3)
        left = wp.identity(n=3, dtype=float) - wp.outer(q0, u0) - wp.outer(q1, u1) - wp.outer(q2, u2) - wp.outer(q3, u3)
        S = L11 * left * wp.transpose(L11)
        y0 = x0 / l00
        y1 = (x1 - l10 * y0) / l11
        y2 = (x2 - l20 * y0 - l21 * y1) / l22
        y3 = (x3 - l30 * y0 - l31 * y1 - l32 * y2) / l33
        share = B0 * log_share(y0) + B1 * log_share(y1) + B2 * log_share(y2) + B3 * log_share(y3)
        B = exponent(beta[i, 0])
        opacity[i] = wp.exp(share) / (1.0 + wp.exp(-stored_opacity[i]))
        kernel_exponent[i] = B

        # symmetric and no smaller than the filter's
        mix = wp.where(lens.upper == 1, 1.0, 0.5)
        s01 = mix * S[0, 1] + (1.0 - mix) * S[1, 0]
        s02 = mix * S[0, 2] + (1.0 - mix) * S[2, 0]
        s12 = mix * S[1, 2] + (1.0 - mix) * S[2, 1]
        added = (lens.world[0] + lens.world[1] * B) * footprint[i] * footprint[i]
        seen = wp.mat33(S[0, 0] + added, s01, s02, s01, S[1, 1] + added, s12, s02, s12, S[2, 2] + added)

        # onto the image plane
        p = R * mean + shift[pose]
        ahead = p[2] > lens.near
        safe = wp.where(ahead, p, wp.vec3(1.0, 1.0, 1.0))
        pixel, row_x, row_y, imaged = through(safe, lens)
        m_x, m_y = wp.transpose(R) * row_x, wp.transpose(R) * row_y
        wider = lens.plane[0] + lens.plane[1] * B
        across = seen * m_y
        a = wp.dot(m_x, seen * m_x) + wider
        b = wp.dot(m_x, across)
        c = wp.dot(m_y, across) + wider
        determinant = a * c - b * b
        if ahead and imaged and determinant > 0.0:
            mean2d[i] = pixel
            conic[i] = wp.vec3(c, -b, a) / determinant
            depth[i] = p[2]
            middle = 0.5 * (a + c)
            radius[i] = wp.sqrt(middle + wp.sqrt(wp.max(middle * middle - determinant, LEAST_SPREAD)))
        else:
            mean2d[i] = wp.vec2(0.0, 0.0)
            conic[i] = wp.vec3(1.0, 0.0, 1.0)
            depth[i] = 0.0
            radius[i] = 0.0

    return project_kernel


PINHOLE, FISHEYE = _kernel(through_pinhole), _kernel(through_fisheye)
_GIVEN = (wp.vec3, *[wp.float32] * 6, wp.mat33, wp.vec3, wp.vec3, wp.float32)  # of an entry of each of `_given`
_PLANE = (wp.vec2, wp.vec3, *[wp.float32] * 4)


class _Project(torch.autograd.Function):
    """Saves its inputs only; a thread computes its primitive again on the way back."""

    @staticmethod
    def forward(
        ctx: Any, view: ViewCamera, settings: RenderSettings, moment: Tensor, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        given, kernel, lens = _given(tensors, moment), _kernel_for(view), _lens(view, settings)
        xyz = given[0]
        out = [xyz.new_empty(len(xyz), *shape) for shape in ((2,), (3,), (), (), (), ())]
        with torch_stream(xyz.device):
            inputs = [*_arrays(given, _GIVEN), lens, *_arrays(out, _PLANE)]
            wp.launch(kernel, len(xyz), inputs, device=wp.device_from_torch(xyz.device), block_dim=_BLOCK)
        ctx.save_for_backward(*given)
        ctx.kernel, ctx.lens = kernel, lens
        ctx.mark_non_differentiable(out[-1])
        return tuple(out)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *cotangents: Tensor) -> tuple[Tensor | None, ...]:
        needed = ctx.needs_input_grad[3:]
        found = [torch.zeros_like(t) if n else None for t, n in zip(ctx.saved_tensors, (*needed, False), strict=True)]
        _adjoint(ctx.kernel, ctx.lens, ctx.saved_tensors, [v.contiguous() for v in cotangents[:5]], found)
        pose = [None if v is None else v.sum(0) for v in found[7:10]]
        return None, None, None, *found[:7], *pose


def _adjoint(
    kernel: Any, lens: Any, given: Sequence[Tensor], on_plane: Sequence[Tensor | None], found: Sequence[Tensor | None]
) -> None:
    """Add to `found`, where there is a tensor, the gradients by `given`."""
    device = given[0].device
    with torch_stream(device):
        inputs = [*_arrays(given, _GIVEN), lens, *[None] * len(_PLANE)]  # a thread makes its own values again
        gradients = [*_arrays(found, _GIVEN), Lens(), *_arrays([*on_plane, None], _PLANE)]
        wp.launch(
            kernel, len(given[0]), inputs, adj_inputs=gradients, adjoint=True, device=wp.device_from_torch(device),
            block_dim=_BLOCK,
        )  # fmt: skip


def _kernel_for(view: ViewCamera) -> Any:
    return PINHOLE if view.fisheye is None else FISHEYE


def _given(tensors: Sequence[Tensor], moment: Tensor) -> list[Tensor]:
    """The kernel's inputs: seven tensors of the primitives, copies of the pose, the moment."""
    pose = [t.detach().expand(_COPIES, *t.shape).contiguous() for t in tensors[7:]]
    return [*(t.detach().contiguous() for t in tensors[:7]), *pose, moment]


def _arrays(tensors: Sequence[Tensor | None], kinds: Sequence[Any]) -> list[Any]:
    """The same memory as Warp's arrays of vectors and matrices; None remains."""
    return [
        None if t is None else wp.from_torch(t, dtype=kind, requires_grad=False)
        for t, kind in zip(tensors, kinds, strict=True)
    ]


def _lens(view: ViewCamera, settings: RenderSettings) -> Any:
    x_low, x_high, y_low, y_high = ray_limits(view)
    lens: Any = Lens()
    lens.f, lens.c = wp.vec2(view.fx, view.fy), wp.vec2(view.cx, view.cy)
    lens.lowest, lens.highest = wp.vec2(x_low, y_low), wp.vec2(x_high, y_high)
    lens.near, lens.upper = settings.near, int(settings.covariance == "upper")
    wider = widening(settings)
    lens.world, lens.plane = wp.vec2(*wider.world), wp.vec2(*wider.plane)
    lens.k = wp.vec4d(*(view.fisheye or (0.0, 0.0, 0.0, 0.0)))
    return lens


def _inputs(p: BetaPrimitives, view: ViewCamera, time: Tensor | None) -> tuple[Tensor, list[Tensor]]:
    moment = p.xyz.new_zeros(1) if time is None else time.detach().to(p.xyz).reshape(1)
    stored = (p.xyz, p.query_mean, p.opacity, p.beta, p.scale, p.lower, p.footprint.detach())
    return moment, [*stored, view.R, view.t, view.center]


def project(
    p: BetaPrimitives, view: ViewCamera, settings: RenderSettings, time: Float[Tensor, ""] | None = None
) -> Projection:
    """`dispatch.project` for float32 on a GPU; no gradient reaches `time`."""
    moment, tensors = _inputs(p, view, time)
    mean2d, conic, opacity, exponent, depth, radius = _Project.apply(view, settings, moment, *tensors)
    return Projection(with_light_kept(Primitives2D(mean2d, conic, p.rgb, opacity, exponent, depth), settings), radius)


def center_gradients(
    p: BetaPrimitives,
    view: ViewCamera,
    settings: RenderSettings,
    on_plane: Float[Tensor, "n k 3"],
    time: Float[Tensor, ""] | None = None,
) -> Float[Tensor, "n k 3"]:
    """`dispatch.center_gradients` for float32 on a GPU."""
    moment, tensors = _inputs(p, view, time)
    given, kernel, lens = _given(tensors, moment), _kernel_for(view), _lens(view, settings)
    found = torch.zeros(on_plane.shape[1], *p.xyz.shape, device=p.xyz.device)
    for by_xyz, v in zip(found, on_plane.detach().unbind(1), strict=True):
        on_centers = [v[:, :2].contiguous(), None, None, None, v[:, 2].contiguous()]
        _adjoint(kernel, lens, given, on_centers, [by_xyz, *[None] * 10])
    return found.transpose(0, 1)
