"""Steps that all recipes with Gaussians share: rendering one view, learning rates, and rows added or removed."""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.splat.densify import adaptive, schedule
from swimm3r.splat.densify.rows import moments_after, only
from swimm3r.splat.gaussian_settings import GaussianSettings, GradientSettings
from swimm3r.splat.medium.field import NO_WATER, MediumField
from swimm3r.splat.optimizer import log_linear
from swimm3r.splat.pose_mlp import pose_rate
from swimm3r.splat.primitives.gaussian import GaussianPrimitives, initial_gaussians, rescaled, to_degree
from swimm3r.splat.projection.view_camera import ViewCamera
from swimm3r.splat.rendering import Drawing, draw
from swimm3r.splat.training import loop
from swimm3r.splat.training.scene import TrainingScene
from swimm3r.splat.training.state import POSES, State, parameters_of
from swimm3r.splat.views import TrainingView

# purposes of randomness (training.generator): 2 primitives, 3 water, 4 densification, 6 poses, 7 matches, 8 noise
_MOST_HASTE = 4.0


InField = State[GaussianPrimitives, MediumField]
S = TypeVar("S", bound=State[GaussianPrimitives, Any])


@dataclass(frozen=True)
class TrainingRender:
    """One view as drawn for training, and what its loss may be differentiated by."""

    p: GaussianPrimitives  # leaves
    shown: GaussianPrimitives  # as drawn: with the harmonics of the step, and what else it changes
    drawing: Drawing
    pinhole_view: ViewCamera
    parameters: dict[str, Tensor]  # the leaves by name, water and poses too

    def gradients(self, loss: Float[Tensor, ""]) -> dict[str, Tensor]:
        """The loss's gradient by name; "mean2d" is that of the projected centers, px."""
        plane = self.drawing.projection.primitives.mean2d
        found = torch.autograd.grad(loss, [*self.parameters.values(), plane], materialize_grads=True)
        return dict(zip([*self.parameters, "mean2d"], found, strict=True))


def first_gaussians(scene: TrainingScene, settings: GaussianSettings) -> GaussianPrimitives:
    """The Gaussians before step 1, in working units."""
    p = initial_gaussians(scene.rec, settings.initial, loop.generator(settings.seed, 0, 2))
    return rescaled(p, scene.scale)


def render_for_training(
    scene: TrainingScene,
    state: State,
    view: TrainingView,
    settings: GaussianSettings,
    step: int,
    sgg: bool = False,
    changed: Callable[[GaussianPrimitives, ViewCamera], GaussianPrimitives] | None = None,
) -> TrainingRender:
    """Draw a view with the harmonics that this step has come to; `sgg` asks for the gradients' parts.

    `changed` gives the Gaussians that are drawn in their place. Water that lies over finished images is not in this
    one.
    """
    p = GaussianPrimitives(*(values.detach().requires_grad_() for values in state.primitives))
    degree = int((step - 1) / (settings.degree_every * settings.iterations))
    pinhole_view = scene.pinhole_view(view, state.poses)
    field = state.field if isinstance(state.field, MediumField) else NO_WATER
    shown = to_degree(p, min(degree, settings.initial.harmonics))
    shown = shown if changed is None else changed(shown, pinhole_view)
    drawing = draw(shown, field, pinhole_view, settings, sgg=sgg)
    return TrainingRender(p, shown, drawing, pinhole_view, parameters_of(p, state.field, state.poses))


def with_matches(
    scene: TrainingScene, state: State, loss: Float[Tensor, ""], settings: GaussianSettings, step: int
) -> tuple[Float[Tensor, ""], loop.Numbers]:
    """The loss, with the epipolar error of the training poses while it takes part, and that for the record."""
    rng = loop.generator(settings.seed, step, 7)
    off = scene.epipolar_error(state.poses, settings.poses, step / settings.iterations, rng)
    if off is None:
        return loss, {}
    return loss + settings.poses.epipolar * off.to(loss), {"epipolar_px": off}


def short_run_rate_exponent(settings: GaussianSettings) -> float:
    """Factor on some published learning rates in a run this short."""
    published = type(settings).iterations
    return min(_MOST_HASTE, max(1.0, published / settings.iterations) ** settings.rates.short_run_rate_exponent)


def rates_of(scene: TrainingScene, settings: GaussianSettings, step: int, names: Collection[str]) -> dict[str, float]:
    """Adam's rates of Gaussians and poses in a step; the water's are the recipe's own."""
    r, faster = settings.rates, short_run_rate_exponent(settings)
    position = scene.radius * log_linear(r.xyz, r.xyz_end, step / settings.iterations)
    hasty = {"xyz": position, "quaternion": r.quaternion, "color": r.color, "harmonics": r.harmonics}
    poses = pose_rate(settings.poses, settings.iterations)
    return {
        **{name: faster * rate for name, rate in hasty.items()},
        "scale": r.scale,
        "opacity": r.opacity,
        **{name: poses for name in names if name.startswith(POSES)},
    }


def densified_by_gradients(
    scene: TrainingScene, state: S, settings: GaussianSettings, d: GradientSettings, step: int
) -> S:
    """The state after the step's part in 3DGS's densification: multiply and cull, and cut opacities back.

    Each has its cadence; nothing happens outside of the window.
    """
    n = settings.iterations
    if not schedule.is_open(d, step, n):
        return state
    p, moments, memory = state.primitives, state.moments, state.memory
    cut_every = max(1, round(d.reset_every * n)) if d.reset_every else n
    if schedule.is_due(d, step, n):
        rng = loop.generator(settings.seed, step, 4)
        done = adaptive.multiply(p, memory, d.grow_grad2d, d.grow_scale3d * scene.radius, settings.cap_max, rng)
        q = done.primitives
        fit = torch.sigmoid(q.opacity) >= d.prune_opacity
        if step > cut_every:
            fit &= q.scale.amax(-1).exp() <= d.prune_scale3d * scene.radius
            fit &= memory["radius"][done.source] <= d.largest_radius
        if int(fit.sum()) >= 4:
            done = only(done, fit)
        p, moments = done.primitives, moments_after(moments, done)
        memory = adaptive.nothing_seen(len(p.xyz), p.xyz.device)
    if d.reset_every and step % cut_every == 0:
        p, moments = adaptive.dimmed(p, moments, d.reset_opacity)
    return replace(state, primitives=p, moments=moments, memory=memory)
