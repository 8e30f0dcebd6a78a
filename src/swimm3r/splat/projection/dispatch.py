"""Primitives on the image plane of a real pinhole camera (uwbs.md 2.1, 1.4).

    mu = (fx x / z + cx, fy y / z + cy),   Sigma2 = J R S R^T J^T + 0.3 I,   conic = Sigma2^-1

J is taken at the ray clamped to 0.3 field tangents beyond the picture. A Beta primitive covers the pixels with r2 < 1
under its conic; its uncapped radius is the square root of Sigma2's larger eigenvalue, 3.33 times that for a Gaussian,
where an opaque one falls below 1/255.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import Cameras
from swimm3r.raster import Kernel, Primitives2D
from swimm3r.splat.gaussian_settings import GaussianRenderSettings
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.primitives.gaussian import GaussianPrimitives, covariance, seen_colour
from swimm3r.splat.projection.conditioning import Conditioned, conditioned_in_view
from swimm3r.splat.settings import RenderSettings

Primitives = BetaPrimitives | GaussianPrimitives
"""What can be projected."""

BLUR = 0.3
"""px^2, added to every covariance on the image plane."""
_GAUSSIAN_REACH = math.sqrt(2 * math.log(255))
_MARGIN = 0.3  # field tangents beyond the picture at which J is held


@dataclass(frozen=True)
class Pinhole:
    """One undistorted camera, world to camera; its pose may carry a gradient."""

    R: Float[Tensor, "3 3"]
    t: Float[Tensor, "3"]
    centre: Float[Tensor, "3"]  # in the world
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def to(self, device: torch.device) -> "Pinhole":
        """The same camera for primitives on a device."""
        return replace(self, R=self.R.to(device), t=self.t.to(device), centre=self.centre.to(device))


@dataclass(frozen=True)
class Projection:
    """What the rasteriser draws, and the radius of each primitive, px, without gradient."""

    primitives: Primitives2D
    radius: Float[Tensor, " n"]
    kernel: Kernel = "beta"


def pinhole(camera: Cameras, dtype: torch.dtype = torch.float32) -> Pinhole:
    """The one camera of a `Cameras`. Raises ValueError for several, or for one with distortion."""
    if len(camera) != 1:
        raise ValueError(f"a map is rendered for one camera at a time, got {len(camera)}")
    if camera.distortion.numel() and bool(camera.distortion.any()):
        raise ValueError(
            f"a map is rendered for pinhole cameras, got {camera.model} with distortion; camera.pinhole() leaves it out"
        )
    R = camera.cam2world[0, :3, :3].mT
    centre = camera.cam2world[0, :3, 3]
    K = camera.K[0].tolist()
    return Pinhole(
        R.to(dtype),
        -(R @ centre).to(dtype),
        centre.to(dtype),
        K[0][0],
        K[1][1],
        K[0][2],
        K[1][2],
        camera.width,
        camera.height,
    )


def ray_limits(view: Pinhole) -> tuple[float, float, float, float]:
    """Lowest and highest x / z, then y / z, at which J is taken."""
    x, y = _MARGIN * 0.5 * view.width / view.fx, _MARGIN * 0.5 * view.height / view.fy
    return (
        -view.cx / view.fx - x,
        (view.width - view.cx) / view.fx + x,
        -view.cy / view.fy - y,
        (view.height - view.cy) / view.fy + y,
    )


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
    seen = conditioned_in_view(p, view.centre, settings, time)
    return project_conditioned(seen, 4 * torch.exp(p.beta[:, 0]), p.rgb, view, settings.near)


def project_gaussians(p: GaussianPrimitives, view: Pinhole, near: float) -> Projection:
    """Gaussians in one camera."""
    seen = Conditioned(p.xyz, covariance(p), torch.sigmoid(p.opacity))
    half = torch.full_like(seen.opacity, 0.5)
    drawn = project_conditioned(seen, half, seen_colour(p, view.centre), view, near)
    return Projection(drawn.primitives, _GAUSSIAN_REACH * drawn.radius, "gaussian")


def project(
    p: Primitives,
    view: Pinhole,
    settings: RenderSettings | GaussianRenderSettings,
    time: Float[Tensor, ""] | None = None,
) -> Projection:
    """Primitives projected into a camera, Beta ones conditioned on it; differentiable in both."""
    if isinstance(p, GaussianPrimitives):
        return project_gaussians(p, view, settings.near)
    assert isinstance(settings, RenderSettings)
    if _has_fast_form(p, settings):
        from swimm3r.splat.projection import cpu_project

        return cpu_project.project(p, view, settings, time)
    return project_plainly(p, view, settings, time)


def centre_gradients(
    p: BetaPrimitives,
    view: Pinhole,
    settings: RenderSettings,
    on_plane: Float[Tensor, "n k 3"],
    time: Float[Tensor, ""] | None = None,
) -> Float[Tensor, "n k 3"]:
    """Gradients of xyz for k gradients of (mean2d, depth): the projection's adjoint for these alone.

    The direction that primitives are conditioned on follows xyz, as in `project`.
    """
    if _has_fast_form(p, settings):
        from swimm3r.splat.projection import cpu_project

        return cpu_project.centre_gradients(p, view, settings, on_plane, time)
    with torch.enable_grad():
        xyz = p.xyz.detach().requires_grad_()
        seen = project_plainly(p._replace(xyz=xyz), view, settings, time).primitives
        centre = torch.cat([seen.mean2d, seen.depth[:, None]], -1)
        parts = [torch.autograd.grad(centre, xyz, v, retain_graph=True)[0] for v in on_plane.unbind(1)]
    return torch.stack(parts, 1)


def _has_fast_form(p: BetaPrimitives, settings: RenderSettings) -> bool:
    return p.xyz.device.type == "cpu" and p.xyz.dtype == torch.float32 and settings.rotation == "first_order"
