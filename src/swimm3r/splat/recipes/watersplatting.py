"""WaterSplatting (Li et al. 2025): Gaussians in water that a small network knows for every direction.

    I = sum_i w_i c_i e^{-beta_D z_i} + Binf V,   L = 0.8 mean |(I - gt) / (sg(I) + eps)| + 0.2 (1 - SSIM)

with both images of SSIM divided by sg(I) + eps, too (docs/derivations/compared-methods.md#watersplatting). The image is
formed as UWBS forms it. Gaussians multiply by absolute gradients and are culled by opacity; opacities are cut back now
and then.

Where we depart from the publication: exact harmonics of the pixel's ray where its encoding sees 2 d - 1; pixel centers
at +0.5; exact gradients where its backward pass leaves out depth and mistakes the cap on alpha; SSIM pads with zeros;
the water's network is asked on a grid of pixels and interpolated, and keeps its optimizer's memory when Gaussians are
culled; the number of Gaussians has the bound that all recipes have. Its schedule densifies only beyond n_train + 100 of
every 500 steps, which long clips never reach: here never more than half of them are waited for. In short runs rounds
are `min_refine_every` steps apart at least, rates grow (`short_run_rate_exponent`), opacities are not cut, and culls
are as after the last round (`with_recipe`): there is no time to grow back.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.splat.densify import adaptive, schedule
from swimm3r.splat.densify.rows import moments_after, only, unchanged
from swimm3r.splat.gaussian_settings import WaterSplattingSettings
from swimm3r.splat.medium.field import MediumField, initial_field
from swimm3r.splat.optimizer import adam_step, log_linear
from swimm3r.splat.recipes.gaussian_step import (
    InField,
    TrainingRender,
    first_gaussians,
    rates_of,
    render_for_training,
    with_matches,
)
from swimm3r.splat.training import loop, losses
from swimm3r.splat.training.scene import TrainingScene
from swimm3r.splat.training.state import FIELD, State, clip_field, first_state, parameters_of
from swimm3r.splat.views import TrainingView, smaller


@dataclass(frozen=True)
class WaterSplatting:
    """The recipe for one scene (`training.loop.Recipe`)."""

    settings: WaterSplattingSettings
    scene: TrainingScene

    def start(self) -> InField:
        """Faint Gaussians on the cloud, and a network at random."""
        seed = self.settings.seed
        p = first_gaussians(self.scene, self.settings)
        field = self._first_field(loop.generator(seed, 0, 3))
        codes = self.scene.codes(self.settings.poses, loop.generator(seed, 0, 6))
        return first_state(p, field, codes, adaptive.nothing_seen(len(p.xyz)))

    def _first_field(self, rng: torch.Generator) -> MediumField:
        return initial_field(None, self.settings.medium, rng)

    def step(self, state: InField, view: TrainingView, step: int) -> tuple[InField, loop.Numbers]:
        """One view at the resolution this step has come to: forward, adjoint, Adam, densification on its cadence."""
        settings = self.settings
        view = smaller(view, self._divisor(step))
        seen = self._render(state, view, step)
        loss, terms = self._objective(seen, view, step)
        total, numbers = with_matches(self.scene, state, loss, settings, step)
        l1 = (seen.drawing.images.rgb.detach() - view.rgb)[:, view.seen].abs().mean()
        numbers |= terms | {"loss": total, "l1": l1, "primitives": float(len(seen.p.xyz))}
        gradients = seen.gradients(total)
        clip_field(gradients)
        assert seen.drawing.sgg is not None
        with torch.no_grad():
            parameters = parameters_of(state.primitives, state.field, state.poses)
            water = log_linear(settings.medium_rate, settings.medium_rate_end, step / settings.iterations)
            rates = dict.fromkeys((name for name in parameters if name.startswith(FIELD)), water)
            adam_step(parameters, gradients, state.moments, rates | rates_of(self.scene, settings, step, parameters))
            memory = adaptive.remembered(
                state.memory, seen.drawing.sgg.full_abs, seen.drawing.projection, seen.pinhole_view
            )
            state = State(state.primitives, state.field, state.poses, state.moments, memory)
            d, n = settings.densify, settings.iterations
            if schedule.has_begun(d, step, n) and schedule.is_due(d, step, n):
                state = self._round(state, step)
        return state, numbers

    def _render(self, state: InField, view: TrainingView, step: int) -> TrainingRender:
        return render_for_training(self.scene, state, view, self.settings, step, sgg=True)

    def _objective(self, seen: TrainingRender, view: TrainingView, step: int) -> tuple[Float[Tensor, ""], loop.Numbers]:
        """The loss of one view without that of the poses, and its terms for the record; the same in every step."""
        w = self.settings.weights
        photo = relative_photometric(seen.drawing.images.rgb, view, w.floor, w.ssim)
        return photo.loss, {"relative_l1": photo.l1, "ssim": photo.ssim}

    def _divisor(self, step: int) -> int:
        """By how much the training image is smaller."""
        doublings = int((step - 1) / (self.settings.double_every * self.settings.iterations))
        return max(1, self.settings.first_divisor >> doublings)

    def _every(self) -> int:
        return schedule.steps_between(self.settings.densify, self.settings.iterations)

    def _period(self) -> int:
        """Steps from one cut of the opacities to the next; all of the run where there is none."""
        d = self.settings.densify
        return (
            self._every() * max(1, round(d.reset_every / d.refine_every)) if d.reset_every else self.settings.iterations
        )

    def _round(self, state: InField, step: int) -> InField:
        """Multiply and cull; cut opacities back on their cadence."""
        d, p, moments, memory = self.settings.densify, state.primitives, state.moments, state.memory
        since = step % self._period()
        growing = step < d.refine_stop * self.settings.iterations
        waits = min(len(self.scene.views) + self._every(), self._period() // 2) if d.reset_every else 0
        if not growing or since > waits:
            done = unchanged(p)
            if growing:
                rng = loop.generator(self.settings.seed, step, 4)
                large = d.grow_scale3d * self.scene.radius
                done = adaptive.multiply(p, memory, d.grow_grad2d, large, self.settings.cap_max, rng)
            q = done.primitives
            fit = torch.sigmoid(q.opacity) >= (d.prune_opacity if growing else d.prune_opacity_late)
            fit &= q.scale.amax(-1).exp() <= d.prune_scale3d * self.scene.radius
            if int(fit.sum()) >= 4:
                done = only(done, fit)
            p, moments = done.primitives, moments_after(moments, done)
            memory = adaptive.nothing_seen(len(p.xyz), p.xyz.device)
        if growing and d.reset_every and since == self._every():
            p, moments = adaptive.dimmed(p, moments, d.reset_opacity)
        return State(p, state.field, state.poses, moments, memory)


def relative_photometric(
    render: Float[Tensor, "3 h w"], view: TrainingView, floor: float, ssim_weight: float
) -> losses.Photometric:
    """reg-L1 and reg-SSIM: both images in units of the rendered value, so that dark water counts as much."""
    unit = render.detach() + floor
    return losses.photometric(render / unit, view.rgb / unit, view.compared(render), ssim_weight)
