"""Scattering-aware geometric gradients (Alg. 1): water must not push the primitives' centers about.

The gradient g0 of a projected center is the sum of what a water-free render asks for and of what scattering does,
g0 = geo + med (`raster.SggBuffers`). With L1 norms, and geo_abs the component-wise sum of absolute values over pixels,

    u = |med| / (|geo| + |med|)    kappa = (|geo_abs| - |geo|) / |geo_abs|    q = (1 - u) kappa
    g_sgg = sign(geo) ((1 - q) |geo| + q geo_abs) + eta u g0

takes the place of g0 on its way to xyz. Cameras, shapes, opacities and colors keep the exact gradient. Once Adam has
moved xyz, its displacement is multiplied by c = 1 + (c_max - 1) u s / (s + s_ref), s the length of the depth loss's own
gradient and s_ref its median: uncertain centers move farther, but not those whose depth is already right.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.raster import SggBuffers, rasterize
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.projection.dispatch import center_gradients
from swimm3r.splat.projection.view_camera import ViewCamera
from swimm3r.splat.rendering import Drawing
from swimm3r.splat.settings import UwbsSettings

_EPS = 1e-12  # losses are means over pixels: gradients of 1e-7 are large


@dataclass(frozen=True)
class Branches:
    """The gradients of projected centers, in parts; geo + med is the plain one."""

    geo: Float[Tensor, "n 2"]
    med: Float[Tensor, "n 2"]
    geo_abs: Float[Tensor, "n 2"]


@dataclass(frozen=True)
class Differentiated:
    """The exact gradient of a loss, and what SGG changes about the step of xyz."""

    gradients: tuple[Tensor, ...]  # of the leaves, as given
    xyz: Float[Tensor, "n 3"]  # added to the gradient of xyz
    multiplier: Float[Tensor, " n"]  # of Adam's displacement of xyz
    uncertainty: Float[Tensor, " n"]


def medium_uncertainty(b: Branches) -> Float[Tensor, " n"]:
    """u: the share of a center's gradient that the water makes; 0 where there is none."""
    geo, med = _length(b.geo), _length(b.med)
    return med / (geo + med + _EPS)


def cancellation(b: Branches) -> Float[Tensor, " n"]:
    """kappa: how much of the geometry's gradient is lost because pixels pull against each other."""
    unsigned = _length(b.geo_abs)
    return ((unsigned - _length(b.geo)) / (unsigned + _EPS)).clamp(0, 1)


def filtered_gradient(b: Branches, residual: float) -> Float[Tensor, "n 2"]:
    """g_sgg: the geometry's direction, its unsigned support where pixels cancel, and a little of the exact gradient."""
    u = medium_uncertainty(b)[:, None]
    q = (1 - u) * cancellation(b)[:, None]
    geometry = torch.sign(b.geo) * ((1 - q) * b.geo.abs() + q * b.geo_abs)
    return geometry + residual * u * (b.geo + b.med)


def step_multiplier(
    uncertainty: Float[Tensor, " n"], isolated: Float[Tensor, "n 3"], largest: float
) -> Float[Tensor, " n"]:
    """c in 1..`largest`: farther the more uncertain, held back where the depth loss's gradient `isolated` is small.

    Where no primitive has such a gradient there is no depth to protect, and uncertainty decides alone.
    """
    s = torch.linalg.vector_norm(isolated, dim=-1)
    median = torch.where(s > 0, s, torch.nan).nanmedian()
    gate = torch.where(median.isnan(), 1.0, s / (s + median))
    return 1 + (largest - 1) * uncertainty * gate


def differentiate(
    total: Float[Tensor, ""],
    depth: Float[Tensor, ""],
    leaves: list[Tensor],
    p: BetaPrimitives,
    drawing: Drawing,
    view: ViewCamera,
    settings: UwbsSettings,
) -> Differentiated:
    """Gradients of `total` in the leaves, and Alg. 1's for the centers of `p`, which was drawn with SggBuffers.

    `depth` is the depth loss as it stands in `total`.
    """
    sgg, buffers, plane = settings.sgg, drawing.sgg, drawing.projection.primitives.mean2d
    assert buffers is not None
    alone, apart = None, sgg.depth == "apart"
    if depth.requires_grad and (apart or sgg.isolated == "exact"):
        alone = torch.autograd.grad(depth, [*leaves, p.xyz, plane], retain_graph=True, materialize_grads=True)
        for buffer in buffers:  # the adjoint has just added to them
            buffer.zero_()
    loss = total - depth if apart else total
    wanted = [*leaves, plane, *drawing.images]
    found = torch.autograd.grad(loss, wanted, materialize_grads=True)
    gradients, g0, on_images = found[: len(leaves)], found[len(leaves)], found[len(leaves) + 1 :]
    branches = Branches(buffers.geo, buffers.med, buffers.geo_abs)
    if sgg.split == "direct" and drawing.maps is not None:
        branches = _direct(drawing, on_images, g0, settings.render.alpha_min)
    on_plane = filtered_gradient(branches, sgg.residual) - g0
    if apart and alone is not None:
        gradients = tuple(a + b for a, b in zip(gradients, alone, strict=False))
        on_plane = on_plane + sgg.residual * medium_uncertainty(branches)[:, None] * alone[-1]
    by_depth = buffers.depth_iso if alone is None else torch.zeros_like(buffers.depth_iso)
    pulls = torch.stack([torch.nn.functional.pad(on_plane, (0, 1)), by_depth], 1)
    xyz, isolated = center_gradients(p, view, settings.render, pulls, drawing.time).unbind(1)
    u = medium_uncertainty(branches)
    multiplier = step_multiplier(u, isolated if alone is None else alone[-2], sgg.largest_step)
    return Differentiated(gradients, xyz, multiplier, u)


def _direct(drawing: Drawing, on_images: tuple[Tensor, ...], g0: Float[Tensor, "n 2"], alpha_min: float) -> Branches:
    """The other split: attenuated light counts as geometry, and only backscatter as medium.

    Light without veil is what water of no color shows, so one more pass through such water tells the two apart.
    """
    p, maps = drawing.projection.primitives, drawing.maps
    assert maps is not None
    p = p._replace(**{name: t.detach() for name, t in p._asdict().items()})
    p = p._replace(mean2d=p.mean2d.requires_grad_())
    dark = maps._replace(Binf=torch.zeros_like(maps.Binf), beta_B=maps.beta_B.detach(), beta_D=maps.beta_D.detach())
    buffers = SggBuffers.zeros(len(p.mean2d), p.mean2d.device)
    height, width = maps.Binf.shape[1:]
    images = rasterize(p, dark, height, width, alpha_min=alpha_min, sgg=buffers)
    (geo,) = torch.autograd.grad(images, p.mean2d, on_images)
    return Branches(geo, g0 - geo, buffers.full_abs)


def _length(v: Float[Tensor, "n 2"]) -> Float[Tensor, " n"]:
    return v.abs().sum(-1)
