"""Primitives on the image plane of a real pinhole camera (docs/derivations/beta-primitives.md#projection).

    mu = (fx x / z + cx, fy y / z + cy),   Sigma2 = J R S R^T J^T + 0.3 I,   conic = Sigma2^-1

J is taken at the ray clamped to 0.3 field tangents beyond the image. A Beta primitive covers the pixels with r2 < 1
under its conic; its uncapped radius is the square root of Sigma2's larger eigenvalue, 3.33 times that for a Gaussian,
where an opaque one falls below 1/255.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.raster import Primitives2D
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.primitives.gaussian import GaussianPrimitives, covariance, seen_color
from swimm3r.splat.projection.conditioning import Conditioned, conditioned_in_view
from swimm3r.splat.projection.pinhole import BLUR, Pinhole, Projection, ray_limits
from swimm3r.splat.settings import RenderSettings

_GAUSSIAN_REACH = math.sqrt(2 * math.log(255))


def project_conditioned(
    seen: Conditioned, exponent: Float[Tensor, " n"], rgb: Float[Tensor, "n 3"], view: Pinhole, near: float
) -> Projection:
    """Symmetric conditioned primitives in one camera, plain form; depth 0 where one cannot be drawn."""
    p = seen.mean @ view.R.mT + view.t
    drawn = p[:, 2] > near
    x, y, z = torch.where(drawn[:, None], p, 1.0).unbind(-1)
    x_low, x_high, y_low, y_high = ray_limits(view)
    tx, ty = z * (x / z).clamp(x_low, x_high), z * (y / z).clamp(y_low, y_high)
    o = torch.zeros_like(z)
    J = torch.stack([view.fx / z, o, -view.fx * tx / z**2, o, view.fy / z, -view.fy * ty / z**2], -1).unflatten(
        -1, (2, 3)
    )
    M = J @ view.R
    Sigma2 = M @ seen.covariance @ M.mT
    a, b, c = Sigma2[:, 0, 0] + BLUR, Sigma2[:, 0, 1], Sigma2[:, 1, 1] + BLUR
    det = a * c - b * b
    drawn = drawn & (det > 0)
    det = torch.where(drawn, det, 1.0)
    mean2d = torch.stack([view.fx * x / z + view.cx, view.fy * y / z + view.cy], -1)
    middle = (a + c) / 2
    largest = middle + (middle * middle - det).clamp(min=0.01).sqrt()
    return Projection(
        Primitives2D(
            mean2d, torch.stack([c, -b, a], -1) / det[:, None], rgb, seen.opacity, exponent, torch.where(drawn, z, 0.0)
        ),
        torch.where(drawn, largest.clamp(min=0).sqrt(), 0.0).detach(),
    )


def project_plainly(
    p: BetaPrimitives, view: Pinhole, settings: RenderSettings, time: Float[Tensor, ""] | None = None
) -> Projection:
    """`project` in torch operations: any D, any dtype, every setting; the oracle of the fast form."""
    seen = conditioned_in_view(p, view.center, settings, time)
    return project_conditioned(seen, 4 * torch.exp(p.beta[:, 0]), p.rgb, view, settings.near)


def project_gaussians(p: GaussianPrimitives, view: Pinhole, near: float) -> Projection:
    """Gaussians in one camera."""
    seen = Conditioned(p.xyz, covariance(p), torch.sigmoid(p.opacity))
    half = torch.full_like(seen.opacity, 0.5)
    drawn = project_conditioned(seen, half, seen_color(p, view.center), view, near)
    return Projection(drawn.primitives, _GAUSSIAN_REACH * drawn.radius, "gaussian")
