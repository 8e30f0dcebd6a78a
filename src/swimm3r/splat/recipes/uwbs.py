"""Underwater Beta Splatting: the objective of Eq. 18, its schedule, and one step of it.

L = L_3DGS + lambda_opa L_opa + lambda_scale L_scale + lambda_depth L_depth + lambda_smooth L_smooth + lambda_rad L_rad

and, beyond the paper, terms that hold the water to what structure from motion measured (`LossWeights.medium_prior`),
the map no nearer than what was measured (`in_front`) and near what was guessed (`guess`), known surfaces opaque
(`coverage`), open water empty (`open_water`), clear colors to those that there are (`gamut`) and, in channels that the
water hides, to those that the others let expect (`hidden`).
"""

import copy
from collections.abc import Collection
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.devices import CPU
from swimm3r.medium import Medium, MediumFit
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.splat.block_store import joined
from swimm3r.splat.densify import mcmc_beta, schedule
from swimm3r.splat.densify.rows import appended, moments_after
from swimm3r.splat.dynamic.linear_motion import ways
from swimm3r.splat.dynamic.spawn import born
from swimm3r.splat.medium.field import MediumField, initial_field, smoothness
from swimm3r.splat.medium.prior import WaterPrior, deviation, water_prior, with_binf_prior
from swimm3r.splat.optimizer import adam_step, log_linear
from swimm3r.splat.pose_mlp import pose_rate
from swimm3r.splat.primitives.beta import BetaPrimitives, initial_primitives, rescaled, trained, with_time
from swimm3r.splat.rendering import Drawing, draw
from swimm3r.splat.settings import UwbsSettings
from swimm3r.splat.training import loop, losses
from swimm3r.splat.training.scene import TrainingScene
from swimm3r.splat.training.sgg import differentiate
from swimm3r.splat.training.state import FIELD, POSES, State, clip_field, first_state, parameters_of
from swimm3r.splat.views import TrainingView, smaller

_HORIZON_STD = 0.2  # of the open water's color around the scene's mean color, as structure from motion assumes

_COARSE = 2  # times the size of a pixel in the first steps


@dataclass(frozen=True)
class _Adjoint:
    """Gradients of one view."""

    gradients: dict[str, Tensor]  # by the names of `parameters_of`
    multiplier: Float[Tensor, " n"] | None  # of the centers' displacement (Alg. 1); None for Adam's own
    numbers: loop.Numbers


@dataclass(frozen=True)
class Uwbs:
    """The recipe for one scene (`training.loop.Recipe`)."""

    settings: UwbsSettings
    scene: TrainingScene
    prior: WaterPrior | None = None  # None where the reconstruction has no water
    gray: bool = False  # frames whose three channels are equal

    def start(self) -> State:
        """Primitives on the cloud, and the reconstruction's water in every direction."""
        settings, scale = self.settings, self.scene.scale
        p = initial_primitives(self.scene.rec, settings.initial, loop.generator(settings.seed, 0, 2))
        if settings.dynamic:
            p = with_time(p, settings.initial, loop.generator(settings.seed, 0, 5))
        p = rescaled(p, scale)
        return first_state(
            p, self._first_water(), self.scene.codes(settings.poses, loop.generator(settings.seed, 0, 6))
        )

    def _first_water(self) -> MediumField:
        """The water that the blocks of a large map share; without, the reconstruction's."""
        if self.scene.surroundings is not None:
            return copy.deepcopy(self.scene.surroundings.water).requires_grad_(True)
        settings, scale = self.settings, self.scene.scale
        medium = None
        fit = measured_water(self.scene.rec)
        if fit is not None:
            medium = Medium(fit.Binf, fit.beta_D / scale, fit.beta_B / scale)
        rng, lamp = loop.generator(settings.seed, 0, 3), self.scene.rec.lamp(scale)
        return initial_field(medium, settings.medium, rng, settings.dynamic, lamp)

    def step(self, state: State, view: TrainingView, step: int) -> tuple[State, loop.Numbers]:
        """One view: forward and adjoint, densification on its cadence, Adam."""
        if self._looks_for_movers(step):
            state = self._with_movers(state, step)
        if self._is_coarse(step):
            view = smaller(view, _COARSE)
        adjoint = self._adjoint(state, view, step)
        rates = self._rates(step, adjoint.gradients)
        if schedule.has_round(self.settings.densify, step, self.settings.iterations):
            state, adjoint = self._densified(state, adjoint, step, rates["xyz"])
        clip_field(adjoint.gradients)
        self._descend(state, adjoint, rates, step)
        return state, adjoint.numbers

    def _adjoint(self, state: State, view: TrainingView, step: int) -> _Adjoint:
        """Gradients of the objective and the epipolar error in one view; the centers' by Alg. 1 while it lasts."""
        settings, share = self.settings, step / self.settings.iterations
        p = BetaPrimitives(*(values.detach().requires_grad_() for values in state.primitives))
        filtered = settings.sgg.enabled and share <= settings.sgg.end
        pinhole_view = self.scene.pinhole_view(view, state.poses)
        drawn = self._with_neighbors(p)
        if self._is_coarse(step):
            settings = _on_larger_pixels(settings)
        drawing = draw(drawn, state.field, pinhole_view, settings, view.time, sgg=filtered)
        loss = objective(drawn, drawing, view, settings, self.prior, self._regularized(share))
        numbers, total = loss.numbers | {"primitives": float(len(p.xyz))}, loss.total
        rng = loop.generator(settings.seed, step, 7)
        off = self.scene.epipolar_error(state.poses, settings.poses, share, rng)
        if off is not None:
            total = total + settings.poses.epipolar * off.to(total)
            numbers |= {"epipolar_px": off}
        leaves = parameters_of(p, state.field, state.poses)
        if not filtered:
            found = torch.autograd.grad(total, [*leaves.values()], materialize_grads=True)
            return _Adjoint(dict(zip(leaves, found, strict=True)), None, numbers)
        sgg = differentiate(total, loss.depth, [*leaves.values()], drawn, drawing, pinhole_view, settings)
        gradients = dict(zip(leaves, sgg.gradients, strict=True))
        gradients["xyz"] = gradients["xyz"] + sgg.xyz[: len(p.xyz)]
        pulled = sgg.uncertainty > 0
        numbers |= {"medium_uncertainty": sgg.uncertainty.sum() / pulled.sum().clamp(min=1)}
        return _Adjoint(gradients, sgg.multiplier[: len(p.xyz)], numbers)

    def _with_neighbors(self, p: BetaPrimitives) -> BetaPrimitives:
        """The primitives that a view is drawn from: those in training, and before finished blocks theirs."""
        around = self.scene.surroundings
        return p if around is None else joined([p, around.neighbors])

    @torch.no_grad()
    def _descend(self, state: State, adjoint: _Adjoint, rates: dict[str, float], step: int) -> None:
        """Adam's step in place, the centers' displacement multiplied (Alg. 1), and noise where every step has it.

        What the images leave open drifts apart in the channels of gray frames, so that these are kept alike.
        """
        parameters = parameters_of(state.primitives, state.field, state.poses)
        xyz, multiplier = parameters["xyz"], adjoint.multiplier
        before = None if multiplier is None else xyz.clone()
        held = ways(state.primitives) if self.settings.dynamic and self.settings.movers.at else None
        adam_step(parameters, adjoint.gradients, state.moments, rates)
        if held is not None:  # each frame would bend them to its own moment, and what is between would be lost
            for name, values in held.values.items():
                parameters[name][held.rows] = values
        if multiplier is not None and before is not None:
            xyz.sub_(before).mul_(multiplier[:, None]).add_(before)
        if self.gray:
            state.primitives.rgb.copy_(state.primitives.rgb.mean(-1, keepdim=True).expand(-1, 3))
            state.field.keep_gray()
        if self.settings.densify.noise_cadence == "step":
            rng = loop.generator(self.settings.seed, step, 8)
            xyz.add_(self._noise(state.primitives, rates["xyz"], rng))

    def _is_coarse(self, step: int) -> bool:
        return step <= self.settings.coarse_until * self.settings.iterations

    def _regularized(self, share: float) -> bool:
        return self.settings.weights.mcmc_begin < share <= self.settings.weights.mcmc_end

    def _looks_for_movers(self, step: int) -> bool:
        return self.settings.dynamic and step == round(self.settings.movers.at * self.settings.iterations)

    def _kept_free(self, step: int) -> float:
        """Share of the primitives' number that is left to what moves until it is born."""
        m = self.settings.movers
        return m.share if self.settings.dynamic and step < m.at * self.settings.iterations else 0.0

    def _with_movers(self, state: State, step: int) -> State:
        """Primitives for what moves, behind the others; their optimizer starts anew."""
        rng = loop.generator(self.settings.seed, step, 9)
        here = state.to(CPU)  # where the images are looked at
        fresh_ones = born(here.primitives, here.field, self.scene.views, self.settings, rng).to(self.scene.device)
        done = appended(state.primitives, fresh_ones)
        return State(done.primitives, state.field, state.poses, moments_after(state.moments, done))

    def _rates(self, step: int, names: Collection[str]) -> dict[str, float]:
        r, share = self.settings.rates, step / self.settings.iterations
        settled = log_linear(
            1.0, r.final_rate_factor, max(0.0, (share - r.rate_decay_start) / (1 - r.rate_decay_start))
        )
        rates = {name: settled * getattr(r, name) for name in BetaPrimitives._fields if name in names}
        rates["xyz"] = self.scene.radius * log_linear(r.xyz, r.xyz_end, share)
        medium = log_linear(r.medium, r.medium_end, share)
        untouched = self.prior is not None and share <= self.settings.medium.begin
        if untouched or self.scene.surroundings is not None:
            medium = 0.0
        rates |= {name: medium for name in names if name.startswith(FIELD)}
        return rates | {
            name: pose_rate(self.settings.poses, self.settings.iterations) for name in names if name.startswith(POSES)
        }

    def _noise(self, p: BetaPrimitives, rate: float, rng: torch.Generator) -> Float[Tensor, "n 3"]:
        d = self.settings.densify
        strength = d.noise_dynamic if self.settings.dynamic else d.noise
        return mcmc_beta.noise(p, strength * rate, d, self.settings.render.rotation, rng)

    @torch.no_grad()
    def _densified(self, state: State, adjoint: _Adjoint, step: int, rate: float) -> tuple[State, _Adjoint]:
        """Relocation and growth, then noise; rows that start anew get no gradient of this step."""
        d = self.settings.densify
        n = len(state.primitives.xyz)
        most = round((1 - self._kept_free(step)) * d.cap_max)
        target = schedule.grown(n, most, d.growth, d, self.settings.iterations)
        rng = loop.generator(self.settings.seed, step, 4)
        done = mcmc_beta.relocate_and_grow(state.primitives, target, d.min_opacity, rng)
        p = done.primitives
        if d.noise_cadence == "round":
            p = p._replace(xyz=p.xyz + self._noise(p, rate, rng))
        gradients, multiplier, stale = dict(adjoint.gradients), adjoint.multiplier, done.changed
        for name in trained(p):
            gradients[name] = gradients[name][done.memory]
            gradients[name][stale] = 0
        if multiplier is not None:
            multiplier = multiplier[done.memory]
            multiplier[stale] = 1
        state = State(p, state.field, state.poses, moments_after(state.moments, done))
        return state, _Adjoint(gradients, multiplier, adjoint.numbers | done.numbers)


def recipe(settings: UwbsSettings, scene: TrainingScene) -> Uwbs:
    """The recipe for one scene, held to the water that structure from motion measured."""
    return Uwbs(settings, scene, known_water(scene, settings), scene.views.frames.gray)


@dataclass(frozen=True)
class UwbsObjective:
    """Eq. 18 for one view."""

    total: Float[Tensor, ""]
    depth: Float[Tensor, ""]  # the depth regularizer as it stands in the total
    numbers: loop.Numbers  # the terms unweighted, for the record


def objective(
    p: BetaPrimitives,
    drawing: Drawing,
    view: TrainingView,
    settings: UwbsSettings,
    prior: WaterPrior | None,
    regularized: bool,
) -> UwbsObjective:
    """Eq. 18 and the terms beyond it. Opacity and scale count only while `regularized`."""
    w = settings.weights
    photo = losses.photometric(drawing.images.rgb, view.rgb, view.compared(drawing.images.rgb), w.ssim)
    edges = losses.edge_weight(view.rgb, w.depth_edges)
    depth_error = losses.depth_error(drawing.images, view.z_depth, edges, w.depth_alpha)
    in_front = losses.in_front(drawing.images, view.z_depth, edges, w.depth_alpha)
    smooth = smoothness(drawing.grid)
    open_share = losses.uncovered(drawing.images, view.surface)
    on_water = losses.drawn_on_water(drawing.images, view.open_water)
    outside = losses.outside_gamut(p, drawing.projection.radius)
    hidden = losses.hidden_colors(p, _arriving(drawing), drawing.projection.radius, w.hidden_transmittance)
    shrunk = view.camera.width / w.max_radius_width if w.max_radius_width else 1.0
    large = losses.oversize(p, drawing.projection.radius, w.max_radius * shrunk)
    depth = w.depth * depth_error
    total = photo.loss + depth + w.medium_smoothness * smooth + w.radius * large
    total = total + w.in_front * in_front + w.coverage * open_share + w.open_water * on_water
    total = total + w.gamut * outside + w.hidden * hidden
    numbers = {"l1": photo.l1, "ssim": photo.ssim, "depth": depth_error, "medium_smoothness": smooth, "radius": large}
    if view.guessed_z_depth is not None:
        off_guess = losses.off_guess(drawing.images, view.guessed_z_depth, w.guess_slack, w.depth_alpha)
        total = total + w.guess * off_guess
        numbers |= {"off_guess": off_guess}
    numbers |= {"in_front": in_front, "uncovered": open_share, "drawn_on_water": on_water}
    numbers |= {"outside_gamut": outside, "hidden": hidden}
    if prior is not None:
        off = deviation(drawing.grid, prior)
        total = total + w.medium_prior * off
        numbers |= {"medium_prior": off}
    if regularized:
        opacity, scale = losses.mean_opacity(p), losses.mean_scale(p, w.ubs_scale_reg_bug)
        total = total + w.opacity * opacity + w.scale * scale
        numbers |= {"opacity": opacity, "scale": scale}
    return UwbsObjective(total, depth, {"loss": total} | numbers)


@torch.no_grad()
def _arriving(drawing: Drawing) -> Float[Tensor, "n 3"]:
    """Share of the light of a view's primitives that arrives: T_D at their z depth in the view's mean water, times the
    light of a lamp on them; 1 in maps without water.
    """
    if drawing.maps is None:
        return torch.ones_like(drawing.projection.primitives.color)
    beta_D = drawing.grid.values[6:9].mean((1, 2))
    T_D = torch.exp(-beta_D * drawing.projection.primitives.depth.clamp(min=0)[:, None])
    return T_D if drawing.light is None else T_D * drawing.light


def _on_larger_pixels(settings: UwbsSettings) -> UwbsSettings:
    """Settings by which views of 1 / _COARSE the size draw primitives as wide, in the scene, as whole views do."""
    render = settings.render
    return replace(settings, render=replace(render, dilation=render.dilation / _COARSE**2))


def measured_water(rec: Reconstruction) -> MediumFit | None:
    """The reconstruction's water; where it leaves Binf open, that is near the scene's mean color as filmed."""
    if rec.medium is None or rec.cloud is None:
        return rec.medium
    return with_binf_prior(rec.medium, rec.cloud.raw.mean(0), _HORIZON_STD)


def known_water(scene: TrainingScene, settings: UwbsSettings) -> WaterPrior | None:
    """The reconstruction's water, per working unit; None for maps without water."""
    fit = measured_water(scene.rec)
    if settings.medium.model == "none" or fit is None:
        return None
    prior = water_prior(fit, 1 / scene.scale, settings.medium)
    return WaterPrior(prior.mean.to(scene.device), prior.std.to(scene.device))
