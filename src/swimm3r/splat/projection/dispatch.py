"""Primitives projected by the fast form where there is one, else by the plain one."""

from types import ModuleType

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.splat.gaussian_settings import GaussianRenderSettings
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.primitives.gaussian import GaussianPrimitives
from swimm3r.splat.primitives.kinds import Primitives
from swimm3r.splat.projection import cpu_project
from swimm3r.splat.projection.plain import project_gaussians, project_plainly
from swimm3r.splat.projection.view_camera import Projection, ViewCamera
from swimm3r.splat.settings import RenderSettings


def project(
    p: Primitives,
    view: ViewCamera,
    settings: RenderSettings | GaussianRenderSettings,
    time: Float[Tensor, ""] | None = None,
) -> Projection:
    """Primitives projected into a camera, Beta ones conditioned on it; differentiable in both."""
    if isinstance(p, GaussianPrimitives):
        assert isinstance(settings, GaussianRenderSettings)
        return project_gaussians(p, view, settings)
    assert isinstance(settings, RenderSettings)
    fast = _fast_form(p, settings)
    return project_plainly(p, view, settings, time) if fast is None else fast.project(p, view, settings, time)


def center_gradients(
    p: BetaPrimitives,
    view: ViewCamera,
    settings: RenderSettings,
    on_plane: Float[Tensor, "n k 3"],
    time: Float[Tensor, ""] | None = None,
) -> Float[Tensor, "n k 3"]:
    """Gradients of xyz for k gradients of (mean2d, depth): the projection's adjoint for these alone.

    The direction that primitives are conditioned on follows xyz, as in `project`.
    """
    fast = _fast_form(p, settings)
    if fast is not None:
        return fast.center_gradients(p, view, settings, on_plane, time)
    with torch.enable_grad():
        xyz = p.xyz.detach().requires_grad_()
        seen = project_plainly(p._replace(xyz=xyz), view, settings, time).primitives
        center = torch.cat([seen.mean2d, seen.depth[:, None]], -1)
        parts = [torch.autograd.grad(center, xyz, v, retain_graph=True)[0] for v in on_plane.unbind(1)]
    return torch.stack(parts, 1)


def _fast_form(p: BetaPrimitives, settings: RenderSettings) -> ModuleType | None:
    """The module that projects them in one pass on their device; None where only the plain form does."""
    if p.xyz.dtype != torch.float32 or settings.rotation != "first_order":
        return None
    if p.xyz.device.type == "cuda":
        from swimm3r.splat.projection import cuda_project  # needs Warp, as every map on a GPU

        return cuda_project
    return cpu_project if p.xyz.device.type == "cpu" else None
