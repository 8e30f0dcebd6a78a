"""Primitives on the image plane of a real camera (docs/derivations/beta-primitives.md#projection).

    mu = (fx x / z + cx, fy y / z + cy),   Sigma2 = J R S R^T J^T + w I,   conic = Sigma2^-1

w is the widening of `pixel_filter`. J is taken at the ray clamped to 0.3 field tangents beyond the image. Of a
fisheye, with rho = |(x, y)|, theta the angle from the axis and d(theta) = theta (1 + k1 theta^2 + ... + k4 theta^8),

    mu = (fx x a + cx, fy y a + cy),   a = d(theta) / rho

and J, which stays bounded, is taken at the primitive itself. A Beta primitive covers the pixels with r2 < 1
under its conic; its uncapped radius is the square root of Sigma2's larger eigenvalue, 3.33 times that for a Gaussian,
where an opaque one falls below 1/255.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.raster import Primitives2D
from swimm3r.splat.gaussian_settings import GaussianRenderSettings
from swimm3r.splat.primitives.beta import BetaPrimitives, kernel_exponent
from swimm3r.splat.primitives.gaussian import GaussianPrimitives, covariance, seen_color
from swimm3r.splat.projection.conditioning import Conditioned, conditioned_in_view
from swimm3r.splat.projection.pixel_filter import linear, smoothed, widening, with_light_kept
from swimm3r.splat.projection.view_camera import Projection, ViewCamera, ray_limits
from swimm3r.splat.settings import RenderSettings

_GAUSSIAN_REACH = math.sqrt(2 * math.log(255))


def project_conditioned(
    seen: Conditioned,
    exponent: Float[Tensor, " n"],
    rgb: Float[Tensor, "n 3"],
    view: ViewCamera,
    settings: RenderSettings | GaussianRenderSettings,
) -> Projection:
    """Symmetric conditioned primitives in one camera, plain form; depth 0 where one cannot be drawn."""
    p = seen.mean @ view.R.mT + view.t
    drawn = p[:, 2] > settings.near
    p = torch.where(drawn[:, None], p, 1.0)
    z = p[:, 2]
    if view.fisheye is None:
        mean2d, J = _through_pinhole(p, view)
    else:
        mean2d, J, falls = _through_fisheye(p, view, view.fisheye)
        drawn = drawn & falls
    M = J @ view.R
    Sigma2 = M @ seen.covariance @ M.mT
    wider = linear(widening(settings).plane, exponent)
    a, b, c = Sigma2[:, 0, 0] + wider, Sigma2[:, 0, 1], Sigma2[:, 1, 1] + wider
    det = a * c - b * b
    drawn = drawn & (det > 0)
    det = torch.where(drawn, det, 1.0)
    middle = (a + c) / 2
    largest = middle + (middle * middle - det).clamp(min=0.01).sqrt()
    conic = torch.stack([c, -b, a], -1) / det[:, None]
    on_plane = Primitives2D(mean2d, conic, rgb, seen.opacity, exponent, torch.where(drawn, z, 0.0))
    radius = torch.where(drawn, largest.clamp(min=0).sqrt(), 0.0).detach()
    return Projection(with_light_kept(on_plane, settings), radius)


def _through_pinhole(p: Float[Tensor, "n 3"], view: ViewCamera) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2 3"]]:
    """Pixels of points in camera axes, and the Jacobian."""
    x, y, z = p.unbind(-1)
    x_low, x_high, y_low, y_high = ray_limits(view)
    tx, ty = z * (x / z).clamp(x_low, x_high), z * (y / z).clamp(y_low, y_high)
    o = torch.zeros_like(z)
    J = torch.stack([view.fx / z, o, -view.fx * tx / z**2, o, view.fy / z, -view.fy * ty / z**2], -1)
    return torch.stack([view.fx * x / z + view.cx, view.fy * y / z + view.cy], -1), J.unflatten(-1, (2, 3))


def _through_fisheye(
    p: Float[Tensor, "n 3"], view: ViewCamera, k: tuple[float, float, float, float]
) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2 3"], Bool[Tensor, " n"]]:
    """Pixels of points in camera axes, the Jacobian, and where the image grows with the angle, as a lens's does."""
    x, y, z = p.unbind(-1)
    rho2 = (x * x + y * y).clamp(min=1e-12)
    distance2, rho = rho2 + z * z, rho2.sqrt()
    theta = torch.atan2(rho, z)
    t2 = theta * theta
    k1, k2, k3, k4 = k
    a = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))) / rho
    slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
    radial = (slope * z / distance2 - a) / rho2
    mixed, ahead = x * y * radial, -slope / distance2
    J = torch.stack([
        view.fx * (a + x * x * radial), view.fx * mixed, view.fx * x * ahead,
        view.fy * mixed, view.fy * (a + y * y * radial), view.fy * y * ahead,
    ], -1)  # fmt: skip
    return torch.stack([view.fx * x * a + view.cx, view.fy * y * a + view.cy], -1), J.unflatten(-1, (2, 3)), slope > 0


def project_plainly(
    p: BetaPrimitives, view: ViewCamera, settings: RenderSettings, time: Float[Tensor, ""] | None = None
) -> Projection:
    """`project` in torch operations: any D, any dtype, every setting; the oracle of the fast form."""
    seen = conditioned_in_view(p, view.center, settings, time)
    return project_conditioned(seen, kernel_exponent(p), p.rgb, view, settings)


def project_gaussians(p: GaussianPrimitives, view: ViewCamera, settings: GaussianRenderSettings) -> Projection:
    """Gaussians in one camera."""
    half = torch.full_like(p.opacity, 0.5)
    seen = Conditioned(p.xyz, smoothed(covariance(p), half, p.footprint, settings), torch.sigmoid(p.opacity))
    drawn = project_conditioned(seen, half, seen_color(p, view.center), view, settings)
    return Projection(drawn.primitives, _GAUSSIAN_REACH * drawn.radius, "gaussian")
