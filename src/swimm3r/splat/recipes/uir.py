"""3D-UIR (Yuan et al. 2025): Gaussians whose colors change with the camera, in a medium of two explicit effects.

    L = 0.8 L1 + 0.2 (1 - SSIM) + lambda_d mean |1/D^ - 1/D| + lambda_s mean min(s_i)

Colors are affine in the Gaussians' own, by position and camera (`medium.affine_colors`); backscatter and attenuation
have networks of their own (`medium.uir`). Depth supervises the rendered one, and Gaussians are flattened; they
multiply, are culled and cut as in 3DGS.

The publication was read in its abstract and in summaries (docs/derivations/compared-methods.md#3d-uir). They do not
state, and are set here after other publications: weights (image and depth after 3DGS, whose depth term falls from 1 to
0.01; flatness after PGSR), networks (the medium's after WaterSplatting, the colors' after WildGaussians), the form of
F_theta (gamma and beta, added to the identity), densification and length (3DGS), the inputs of the medium's networks
(the ray) and the forming of the image (along it). Where we depart from what they state: depth is that of the
reconstruction, in its own scale, and not a network's for single images, so that nothing has to be aligned; where it is
unknown nothing is supervised. SSIM pads with zeros; the number of Gaussians has the bound that all recipes have. In
short runs rounds are `min_refine_every` steps apart at least, rates grow (`short_run_rate_exponent`), and opacities are
not cut (`with_recipe`).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.raster import RasterOutput
from swimm3r.splat.densify import adaptive
from swimm3r.splat.gaussian_settings import UirSettings
from swimm3r.splat.medium.uir import initial_uir_field
from swimm3r.splat.optimizer import adam_step, log_linear
from swimm3r.splat.primitives.gaussian import GaussianPrimitives
from swimm3r.splat.recipes.gaussian_step import (
    InField,
    densified_by_gradients,
    first_gaussians,
    rates_of,
    render_for_training,
    with_matches,
)
from swimm3r.splat.training import loop, losses
from swimm3r.splat.training.scene import TrainingScene, third_of_depth
from swimm3r.splat.training.state import FIELD, State, first_state, parameters_of
from swimm3r.splat.views import TrainingView

_COLORS = f"{FIELD}affine_colors."


def recipe(settings: UirSettings, scene: TrainingScene) -> "Uir":
    """The recipe for one scene."""
    return Uir(settings, scene, third_of_depth(scene))


@dataclass(frozen=True)
class Uir:
    """The recipe for one scene (`training.loop.Recipe`)."""

    settings: UirSettings
    scene: TrainingScene
    unit: float  # of depths and scales, working units

    def start(self) -> InField:
        """Faint Gaussians on the cloud in their own colors, and a medium at random."""
        settings, seed = self.settings, self.settings.seed
        p = first_gaussians(self.scene, settings)
        field = initial_uir_field(settings.medium, settings.affine_colors, p.xyz, loop.generator(seed, 0, 3))
        codes = self.scene.codes(settings.poses, loop.generator(seed, 0, 6))
        return first_state(p, field, codes, adaptive.nothing_seen(len(p.xyz)))

    def step(self, state: InField, view: TrainingView, step: int) -> tuple[InField, loop.Numbers]:
        """One view: forward, adjoint, Adam, densification on its cadence."""
        settings, w = self.settings, self.settings.weights
        share = step / settings.iterations
        seen = render_for_training(self.scene, state, view, settings, step)
        images = seen.drawing.images
        photo = losses.photometric(images.rgb, view.rgb, view.compared(images.rgb), w.ssim)
        depth = inverse_depth_error(images, view.z_depth, w.depth_alpha) * self.unit
        flat = smallest_scale(seen.p) / self.unit
        loss = photo.loss + (w.depth and log_linear(w.depth, w.depth_end, share)) * depth + w.flat * flat
        total, numbers = with_matches(self.scene, state, loss, settings, step)
        numbers |= {"loss": total, "l1": photo.l1, "ssim": photo.ssim, "depth": depth, "flat": flat}
        numbers |= {"primitives": float(len(seen.p.xyz))}
        gradients = seen.gradients(total)
        with torch.no_grad():
            parameters = parameters_of(state.primitives, state.field, state.poses)
            medium = log_linear(settings.medium_rate, settings.medium_rate_end, share)
            rates = {name: self._field_rate(name, medium) for name in parameters if name.startswith(FIELD)}
            adam_step(parameters, gradients, state.moments, rates | rates_of(self.scene, settings, step, parameters))
            memory = adaptive.remembered(state.memory, gradients["mean2d"], seen.drawing.projection, seen.pinhole_view)
            state = State(state.primitives, state.field, state.poses, state.moments, memory)
            state = densified_by_gradients(self.scene, state, settings, settings.densify, step)
        return state, numbers

    def _field_rate(self, name: str, medium: float) -> float:
        return self.settings.affine_colors.rate if name.startswith(_COLORS) else medium


def inverse_depth_error(images: RasterOutput, z_depth: Float[Tensor, "h w"], least_alpha: float) -> Float[Tensor, ""]:
    """L_depth: mean |1/D^ - 1/D| over the pixels of known depth D that the map covers; 0 for none."""
    counted = (z_depth > 0) & (images.alpha.detach() > least_alpha)
    nearest = 1e-3 * least_alpha
    off = (images.alpha / images.z_depth.clamp(min=nearest) - 1 / z_depth.clamp(min=1e-3)).abs()
    return torch.where(counted, off, 0.0).sum() / counted.sum().clamp(min=1)


def smallest_scale(p: GaussianPrimitives) -> Float[Tensor, ""]:
    """L_flat: mean smallest scale, which flattens Gaussians onto surfaces."""
    return p.scale.amin(-1).exp().mean()
