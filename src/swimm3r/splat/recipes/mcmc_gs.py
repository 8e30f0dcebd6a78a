"""Gaussian MCMC (Kheradmand et al. 2024) and, with the training poses refined, 3R-GS (Huang et al. 2025).

    L = 0.8 L1 + 0.2 (1 - SSIM) + 0.01 mean o + 0.01 mean s  [+ 2 L_epi early on]

No water: what it adds becomes part of the colors. 3R-GS is this with `training_poses` refined, at its own rates;
3DGS-MCMC is this with poses held. Where we depart from the publications (docs/derivations/compared-methods.md): the
points are those of every other recipe instead of random ones with 3R-GS's noise; a step draws
`TrainingPoseSettings.matches` matches where 3R-GS takes every twentieth; SSIM pads with zeros; in short runs rounds are
`min_refine_every` steps apart at least, rates grow (`short_run_rate_exponent`), and Gaussians start larger
(`with_recipe`).
"""

from dataclasses import dataclass

import torch

from swimm3r.splat.densify import mcmc_gaussian, schedule
from swimm3r.splat.densify.rows import moments_after
from swimm3r.splat.gaussian_settings import McmcGsSettings
from swimm3r.splat.medium.field import MediumField
from swimm3r.splat.optimizer import adam_step
from swimm3r.splat.recipes.gaussian_step import (
    InField,
    first_gaussians,
    rates_of,
    render_for_training,
    with_matches,
)
from swimm3r.splat.shared_settings import MediumFieldSettings
from swimm3r.splat.training import loop, losses
from swimm3r.splat.training.scene import TrainingScene
from swimm3r.splat.training.state import State, first_state, parameters_of
from swimm3r.splat.views import TrainingView


@dataclass(frozen=True)
class McmcGs:
    """The recipe for one scene (`training.loop.Recipe`)."""

    settings: McmcGsSettings
    scene: TrainingScene

    def start(self) -> InField:
        """Small Gaussians on the cloud, colored as filmed."""
        codes = self.scene.codes(self.settings.poses, loop.generator(self.settings.seed, 0, 6))
        no_water = MediumField(MediumFieldSettings(model="none"))
        return first_state(first_gaussians(self.scene, self.settings), no_water, codes)

    def step(self, state: InField, view: TrainingView, step: int) -> tuple[InField, loop.Numbers]:
        """One view: forward, adjoint, Adam, relocation and growth on their cadence, noise."""
        settings, w = self.settings, self.settings.weights
        seen = render_for_training(self.scene, state, view, settings, step)
        rgb = seen.drawing.images.rgb
        photo = losses.photometric(rgb, view.rgb, view.compared(rgb), w.ssim)
        opacity, scale = torch.sigmoid(seen.p.opacity).mean(), seen.p.scale.exp().mean()
        loss = photo.loss + w.opacity * opacity + w.scale * scale
        total, numbers = with_matches(self.scene, state, loss, settings, step)
        numbers |= {"loss": total, "l1": photo.l1, "ssim": photo.ssim}
        numbers |= {"opacity": opacity, "scale": scale}
        numbers |= {"primitives": float(len(seen.p.xyz))}
        gradients = seen.gradients(total)
        with torch.no_grad():
            parameters = parameters_of(state.primitives, state.field, state.poses)
            rates = rates_of(self.scene, settings, step, parameters)
            adam_step(parameters, gradients, state.moments, rates)
            if schedule.has_round(settings.densify, step, settings.iterations):
                state, counts = self._densified(state, step)
                numbers |= counts
            rng = loop.generator(settings.seed, step, 8)
            p, d = state.primitives, settings.densify
            p.xyz.add_(mcmc_gaussian.noise(p, d.noise * rates["xyz"], d.min_opacity, rng))
        return state, numbers

    def _densified(self, state: InField, step: int) -> tuple[InField, dict[str, float]]:
        d, n = self.settings.densify, len(state.primitives.xyz)
        target = schedule.grown(n, self.settings.cap_max, d.growth, d, self.settings.iterations)
        rng = loop.generator(self.settings.seed, step, 4)
        done = mcmc_gaussian.relocate_and_grow(state.primitives, target, d.min_opacity, rng)
        return State(done.primitives, state.field, state.poses, moments_after(state.moments, done)), done.numbers
