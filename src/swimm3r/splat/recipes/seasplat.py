"""SeaSplat (Yang et al. 2024): Gaussians first, then one set of water coefficients over their images.

For a third of the run I = J + b (1 - alpha) before a learned background b; then the water of `scene_water`, whose Binf
begins as b. It learns in bursts that the run does not count: 1,000 steps of its own when it comes, followed by 2,000 of
the colors alone, and 50 more every 100 steps; in between it stands still. Losses
(docs/derivations/compared-methods.md#seasplat), with d detached where it weighs:

    0.8 L1 + 0.2 (1 - SSIM)                     mean |d (I - gt)|                0.01 mean alpha where I looks like Binf
    2 mean |grad d| e^{-grad gt}                and with water: 0.1 mean_c (mean J_c - 0.5)^2
    2 mean (relu(-J) + relu(J - 0.7))^2         mean relu(gt - B) + 1000 smooth-L1(relu(B - gt))

Gaussians multiply, are culled and cut as in 3DGS. Where we depart from the publication: SSIM pads with zeros; the
number of Gaussians has the bound that all recipes have; `clear` images are divided by alpha as everybody's are. In
short runs rounds are `min_refine_every` steps apart at least, rates grow (`short_run_rate_exponent`), and opacities are
not cut (`with_recipe`).
"""

from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import relu, smooth_l1_loss

from swimm3r.raster import RasterOutput
from swimm3r.splat.densify import adaptive
from swimm3r.splat.gaussian_settings import SeaSplatSettings, SeaSplatWeights
from swimm3r.splat.medium.seasplat import SceneWater, initial_scene_water, layer, relative_depth, seen_through
from swimm3r.splat.optimizer import Moments, adam_step, fresh
from swimm3r.splat.primitives.gaussian import GaussianPrimitives
from swimm3r.splat.recipes.gaussian_step import (
    densified_by_gradients,
    first_gaussians,
    rates_of,
    render_for_training,
    with_matches,
)
from swimm3r.splat.training import loop, losses
from swimm3r.splat.training.scene import TrainingScene
from swimm3r.splat.training.state import FIELD, State, first_state, parameters_of
from swimm3r.splat.views import TrainingView

UnderWater = State[GaussianPrimitives, SceneWater]
_SMOOTH = 0.2  # of smooth-L1
_KEPT = 32  # images, of the Gaussians that stand still while the water learns


@dataclass(frozen=True)
class SeaSplat:
    """The recipe for one scene (`training.loop.Recipe`)."""

    settings: SeaSplatSettings
    scene: TrainingScene

    def start(self) -> UnderWater:
        """Faint Gaussians on the cloud, colored as filmed."""
        seed = self.settings.seed
        p = first_gaussians(self.scene, self.settings)
        water = initial_scene_water(loop.generator(seed, 0, 3))
        codes = self.scene.codes(self.settings.poses, loop.generator(seed, 0, 6))
        return first_state(p, water, codes, adaptive.nothing_seen(len(p.xyz)))

    def step(self, state: UnderWater, view: TrainingView, step: int) -> tuple[UnderWater, loop.Numbers]:
        """Bursts where they are due, then one view: forward, adjoint, Adam, densification on its cadence."""
        settings, w, wet = self.settings, self.settings.weights, step > self._dry_steps()
        if step == self._dry_steps() + 1:
            state = self._filled(state, step)
        elif wet and step % self._share(settings.water.every) == 0:
            self._water_burst(state, step, settings.water.burst * settings.water.every * settings.iterations)
        seen = render_for_training(self.scene, state, view, settings, step)
        found = objective(seen.drawing.images, state.field, view, w, wet)
        total, numbers = with_matches(self.scene, state, found.total, settings, step)
        numbers |= found.numbers | {"loss": total, "primitives": float(len(seen.p.xyz))}
        gradients = seen.gradients(total)
        with torch.no_grad():
            still = () if wet else (f"{FIELD}veil",)
            parameters = parameters_of(state.primitives, state.field, state.poses)
            moving = {name: t for name, t in parameters.items() if not name.startswith(FIELD) or name in still}
            rates = rates_of(self.scene, settings, step, parameters) | dict.fromkeys(still, settings.water.rate)
            adam_step(moving, gradients, state.moments, rates)
            memory = adaptive.remembered(state.memory, gradients["mean2d"], seen.drawing.projection, seen.pinhole_view)
            state = State(state.primitives, state.field, state.poses, state.moments, memory)
            state = densified_by_gradients(self.scene, state, settings, settings.densify, step)
        return state, numbers

    def _share(self, of: float) -> int:
        return max(1, round(of * self.settings.iterations))

    def _dry_steps(self) -> int:
        return int(self.settings.water.begin * self.settings.iterations)

    def _filled(self, state: UnderWater, step: int) -> UnderWater:
        """The state when the water has come, with an optimizer of its own; then the colors without it."""
        names = [name for name in state.moments if name.startswith(FIELD)]
        moments: dict[str, Moments] = state.moments | {name: fresh(state.moments[name].first) for name in names}
        state = State(state.primitives, state.field, state.poses, moments, state.memory)
        water = self.settings.water
        self._water_burst(state, step, water.first_burst * self.settings.iterations)
        for k in self._draws(step, 11, water.color_burst * self.settings.iterations):
            view = self.scene.view(k)
            seen = render_for_training(self.scene, state, view, self.settings, step)
            gradients = seen.gradients(
                objective(seen.drawing.images, state.field, view, self.settings.weights, True).total
            )
            rates = rates_of(self.scene, self.settings, step, state.moments)
            colors = {name: getattr(state.primitives, name) for name in ("color", "harmonics")}
            with torch.no_grad():
                adam_step(colors, gradients, state.moments, rates)
        return state

    def _water_burst(self, state: UnderWater, step: int, count: float) -> None:
        """Steps of the water alone."""
        parameters: dict[str, Tensor] = {f"{FIELD}{name}": t for name, t in state.field.named_parameters()}
        rates = dict.fromkeys(parameters, self.settings.water.rate)

        @lru_cache(maxsize=_KEPT)
        def as_it_stands(k: int) -> tuple[TrainingView, RasterOutput]:
            view = self.scene.view(k)
            with torch.no_grad():
                return view, render_for_training(self.scene, state, view, self.settings, step).drawing.images

        for k in self._draws(step, 10, count):
            view, images = as_it_stands(k)
            loss = objective(images, state.field, view, self.settings.weights, True).total
            found = torch.autograd.grad(loss, list(parameters.values()), materialize_grads=True)
            with torch.no_grad():
                adam_step(parameters, dict(zip(parameters, found, strict=True)), state.moments, rates)

    def _draws(self, step: int, purpose: int, count: float) -> list[int]:
        """Some views, drawn anew each time."""
        rng = loop.generator(self.settings.seed, step, purpose)
        return torch.randint(len(self.scene.views), (max(1, round(count)),), generator=rng).tolist()


@dataclass(frozen=True)
class SeaSplatObjective:
    """The losses of one view."""

    total: Float[Tensor, ""]
    numbers: loop.Numbers  # unweighted, for the record


def objective(
    images: RasterOutput, water: SceneWater, view: TrainingView, w: SeaSplatWeights, wet: bool
) -> SeaSplatObjective:
    """The sum of the losses of a clear view, with the water over it once it is `wet`."""
    J, depth = images.clear, relative_depth(images)
    shown = seen_through(J, layer(water, depth)) if wet else J + water.Binf[:, None, None] * (1 - images.alpha)
    photo = losses.photometric(shown, view.rgb, view.compared(shown), w.ssim)
    terms = {
        "far": (w.far, mean_seen(depth.detach() * (shown - view.rgb).abs(), view.seen)),
        "background": (w.background, covered_background(shown if wet else J, images.alpha, water, view, w)),
        "smooth_depth": (w.smooth_depth, depth_steps(depth, view)),
    }
    if wet:
        terms |= {
            "gray": (w.gray, (torch.stack([mean_seen(channel, view.seen) for channel in J]) - 0.5).square().mean()),
            "saturation": (w.saturation, mean_seen((relu(-J) + relu(J - w.saturated)).square(), view.seen)),
            "dark": (w.dark, dark_channel(layer(water, depth.detach()).backscatter, view, w.negative)),
        }
    total = photo.loss
    for weight, term in terms.values():
        total = total + weight * term
    numbers = {"l1": photo.l1, "ssim": photo.ssim} | {name: term for name, (_, term) in terms.items()}
    return SeaSplatObjective(total, numbers)


def mean_seen(values: Float[Tensor, "*c h w"], seen: Bool[Tensor, "h w"]) -> Float[Tensor, ""]:
    """Mean over the pixels that count."""
    return torch.where(seen, values, 0.0).mean() / seen.float().mean().clamp(min=1e-6)


def covered_background(
    shown: Float[Tensor, "3 h w"],
    alpha: Float[Tensor, "h w"],
    water: SceneWater,
    view: TrainingView,
    w: SeaSplatWeights,
) -> Float[Tensor, ""]:
    """Mean alpha of the pixels that have the color of the open water: nothing should stand there. 0 without any."""
    off = (shown.detach() - water.Binf.detach()[:, None, None]).square().sum(0)  # vector_norm is 30 times as slow
    open_water = (off < w.background_distance**2) & view.seen
    return torch.where(open_water, alpha, 0.0).sum() / open_water.sum().clamp(min=1)


def depth_steps(depth: Float[Tensor, "h w"], view: TrainingView) -> Float[Tensor, ""]:
    """Mean difference of neighboring depths, the less the brighter the image becomes (signed, as published)."""
    total = depth.new_zeros(())
    for axis in (0, 1):
        brighter = view.rgb.diff(dim=1 + axis).mean(0)
        both = view.seen.narrow(axis, 1, view.seen.shape[axis] - 1) & view.seen.narrow(
            axis, 0, view.seen.shape[axis] - 1
        )
        total = total + mean_seen((depth.diff(dim=axis) * torch.exp(-brighter)).abs(), both)
    return total


def dark_channel(backscatter: Float[Tensor, "3 h w"], view: TrainingView, negative: float) -> Float[Tensor, ""]:
    """Light left of the image without its backscatter, which is to be small, and much more what is below 0."""
    direct = torch.where(view.seen, view.rgb - backscatter, 0.0)
    beyond = smooth_l1_loss(relu(-direct), torch.zeros_like(direct), beta=_SMOOTH)
    return (relu(direct).mean() + negative * beyond) / view.seen.float().mean().clamp(min=1e-6)
