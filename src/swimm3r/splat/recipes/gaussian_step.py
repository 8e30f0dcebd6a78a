"""Steps that all recipes with Gaussians share: rendering one view, learning rates, and rows added or removed."""

from collections.abc import Collection
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.splat.gaussian_settings import GaussianSettings
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


@dataclass(frozen=True)
class TrainingRender:
    """One view as drawn for training, and what its loss may be differentiated by."""

    p: GaussianPrimitives  # leaves
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
    scene: TrainingScene, state: State, view: TrainingView, settings: GaussianSettings, step: int, sgg: bool = False
) -> TrainingRender:
    """Draw a view with the harmonics that this step has come to; `sgg` asks for the gradients' parts.

    Water that lies over finished images is not in this one.
    """
    p = GaussianPrimitives(*(values.detach().requires_grad_() for values in state.primitives))
    degree = int((step - 1) / (settings.degree_every * settings.iterations))
    pinhole_view = scene.pinhole_view(view, state.poses)
    field = state.field if isinstance(state.field, MediumField) else NO_WATER
    drawing = draw(to_degree(p, min(degree, settings.initial.harmonics)), field, pinhole_view, settings, sgg=sgg)
    return TrainingRender(p, drawing, pinhole_view, parameters_of(p, state.field, state.poses))


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
