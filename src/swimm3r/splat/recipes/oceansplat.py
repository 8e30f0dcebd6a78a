"""OceanSplat (Kweon & Park 2026): WaterSplatting whose geometry agrees between virtual views of the map itself.

    L = L_photo + 0.1 L_tri + lambda_epi L_epi + 0.01 L_res,   lambda_epi from 0.4 to 0.2

L_photo, water and densification are those of `recipes.watersplatting`. L_tri (`training.trinocular`) compares the view
with virtual ones from beside and below it, L_epi and L_res (`training.epipolar_depth`) hold depth and Gaussians to each
other, and early in training opacities are adjusted by depth and direction (`training.alpha_adjustment`).

The publication was read in its abstract and in summaries (docs/derivations/compared-methods.md#oceansplat). They do
not state, and are set here: the unit of the baselines and depths (a third of the scene's median depth, which is a
working unit where the scene has no scale); the weights within L_tri (1 for objects and for the full image, each a mean
over the two virtual views; 1e-3 for smoothness, Monodepth2's); the pixels that count (seen, and half covered); the
opacity from which Gaussians are triangulated (0.5) and that the nearest of a pixel counts; the network, end and fade of
the adjustment; the fall of lambda_epi (linear); the shares of the run with small images, and culls (WaterSplatting's).
Triangulated depth has no gradient. Otherwise the departures are those of `recipes.watersplatting`.
"""

from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from swimm3r.raster import rasterize
from swimm3r.splat.gaussian_settings import AlphaAdjustmentSettings, OceanSplatSettings
from swimm3r.splat.medium.field import MediumField, at_random
from swimm3r.splat.primitives.gaussian import GaussianPrimitives
from swimm3r.splat.projection.dispatch import project
from swimm3r.splat.projection.view_camera import Projection, ViewCamera
from swimm3r.splat.recipes.gaussian_step import InField, TrainingRender, render_for_training
from swimm3r.splat.recipes.watersplatting import WaterSplatting
from swimm3r.splat.rendering import expected_z_depth
from swimm3r.splat.shared_settings import MediumFieldSettings
from swimm3r.splat.training import loop
from swimm3r.splat.training.alpha_adjustment import AlphaNetwork, adjusted_opacity, adjustment_weight
from swimm3r.splat.training.epipolar_depth import depth_residual, epipolar_error, epipolar_prior
from swimm3r.splat.training.scene import TrainingScene, third_of_depth
from swimm3r.splat.training.trinocular import disparity_roughness, inverse_warp, relative_l1, virtual_shifts
from swimm3r.splat.views import TrainingView

# purposes of randomness (training.generator), beside those of gaussian_step: 12 virtual views


class OceanField(MediumField):
    """The water's network, and that of the opacities early in training, which a finished map does not ask."""

    def __init__(self, medium: MediumFieldSettings, alpha: AlphaAdjustmentSettings) -> None:
        super().__init__(medium)
        self.alpha = AlphaNetwork(alpha.hidden)


def recipe(settings: OceanSplatSettings, scene: TrainingScene) -> "OceanSplat":
    """The recipe for one scene."""
    return OceanSplat(settings, scene, third_of_depth(scene))


@dataclass(frozen=True)
class OceanSplat(WaterSplatting):
    """The recipe for one scene (`training.loop.Recipe`)."""

    settings: OceanSplatSettings
    unit: float  # of baselines and depths, working units

    def _first_field(self, rng: torch.Generator) -> MediumField:
        """WaterSplatting's network at random, and opacities that are not adjusted yet."""
        field = at_random(OceanField(self.settings.medium, self.settings.alpha), rng)
        with torch.no_grad():
            field.alpha.last.weight.zero_()
        return field

    def _render(self, state: InField, view: TrainingView, step: int) -> TrainingRender:
        w = adjustment_weight(self.settings.alpha, step / self.settings.iterations)
        changed = None
        if w > 0:
            assert isinstance(state.field, OceanField)
            changed = partial(adjusted, network=state.field.alpha, unit=self.unit, w=w)
        return render_for_training(self.scene, state, view, self.settings, step, sgg=True, changed=changed)

    def _objective(self, seen: TrainingRender, view: TrainingView, step: int) -> tuple[Float[Tensor, ""], loop.Numbers]:
        w, share = self.settings.weights, step / self.settings.iterations
        photo, numbers = super()._objective(seen, view, step)
        shifts = virtual_shifts(self.settings.virtual, self.unit, loop.generator(self.settings.seed, step, 12))
        of = geometry(seen, view, shifts.to(view.rgb), self.settings, self.unit)
        epipolar = w.epipolar + share * (w.epipolar_end - w.epipolar)
        tri = of["object_stereo"] + of["full_stereo"] + w.disparity_smoothness * of["roughness"]
        loss = photo + w.trinocular * tri + epipolar * of["epipolar"] + w.residual * of["residual"]
        return loss, numbers | of


def adjusted(
    p: GaussianPrimitives, view: ViewCamera, network: AlphaNetwork, unit: float, w: float
) -> GaussianPrimitives:
    """The Gaussians with the opacities that the network gives them before a camera; it does not move them."""
    with torch.no_grad():
        z = (p.xyz @ view.R[2] + view.t[2]) / unit
        direction = normalize(p.xyz - view.center, dim=-1)
    return p._replace(opacity=adjusted_opacity(network, p.opacity, z, direction, w))


def geometry(
    seen: TrainingRender, view: TrainingView, shifts: Float[Tensor, "2 3"], settings: OceanSplatSettings, unit: float
) -> dict[str, Float[Tensor, ""]]:
    """The terms of L_tri, L_epi and L_res, unweighted; depths are in `unit`."""
    images, virtual, floor = seen.drawing.images, settings.virtual, settings.weights.floor
    near = settings.render.near
    D = expected_z_depth(images)
    counted = view.seen & (images.alpha >= virtual.least_alpha)
    own = object_light(seen, seen.drawing.projection, settings)
    medium = images.rgb - own
    objects, full = D.new_zeros(()), D.new_zeros(())
    for shift in shifts:
        beside = project(seen.shown, seen.pinhole_view.shifted(shift), settings.render)
        warped = inverse_warp(object_light(seen, beside, settings), D, seen.pinhole_view, shift)
        both = counted & warped.inside
        objects = objects + relative_l1(warped.image, own, both, floor) / len(shifts)
        full = full + relative_l1(warped.image + medium, view.rgb, both, floor) / len(shifts)
    points = seen.p.xyz @ seen.pinhole_view.R.mT + seen.pinhole_view.t
    opaque = torch.sigmoid(seen.shown.opacity) > virtual.least_opacity
    prior = epipolar_prior(points[opaque], seen.pinhole_view, shifts, near)
    return {
        "object_stereo": objects,
        "full_stereo": full,
        "roughness": disparity_roughness(D, view.rgb, counted),
        "epipolar": epipolar_error(D / unit, prior / unit, view.rgb, counted),
        "residual": depth_residual(points, D, images.alpha, seen.pinhole_view, near, virtual.least_alpha) / unit,
    }


def object_light(seen: TrainingRender, projection: Projection, settings: OceanSplatSettings) -> Float[Tensor, "3 h w"]:
    """C_obj = sum_i w_i c_i e^{-sigma_attn z_i}: light of the Gaussians through the medium, without the medium's own.

    Virtual cameras look the same way as the camera, so that its pixels' medium is theirs.
    """
    maps, view = seen.drawing.maps, seen.pinhole_view
    dark = None if maps is None else maps._replace(Binf=torch.zeros_like(maps.Binf))
    return rasterize(
        projection.primitives, dark, view.height, view.width,
        alpha_min=settings.render.alpha_min, kernel=projection.kernel,
        medium_depth_grad=settings.render.medium_depth_grad == "full",
    ).rgb  # fmt: skip
