"""Underwater Beta Splatting: the objective of Eq. uwbs_total, its schedule, and one step of it.

L = L_3DGS + lambda_opa L_opa + lambda_scale L_scale + lambda_depth L_depth + lambda_smooth L_smooth + lambda_rad L_rad

and, beyond the paper, terms that hold the water to what structure from motion measured (`LossWeights.medium_prior`) and
known surfaces opaque (`coverage`).
"""

import hashlib
import json
import math
from collections.abc import Collection
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from swimm3r.frames import Frames
from swimm3r.medium import Medium
from swimm3r.progress import Progress, silent
from swimm3r.reconstruction import Reconstruction
from swimm3r.splat import checkpoint, densify, losses, training
from swimm3r.splat.gradients import differentiate
from swimm3r.splat.medium_field import MediumField, WaterPrior, deviation, initial_field, smoothness, water_prior
from swimm3r.splat.optimiser import Moments, adam_step, fresh, log_linear
from swimm3r.splat.pose_codes import PoseCodes, Stations, training_stations, write_refined
from swimm3r.splat.primitives import BetaPrimitives, initial_primitives, rescaled, with_time
from swimm3r.splat.projection import pinhole
from swimm3r.splat.rendering import Drawing, SplatMap, draw
from swimm3r.splat.settings import UwbsSettings
from swimm3r.splat.views import TrainingViews, View, working_scale


@dataclass(frozen=True)
class State:
    """Primitives, water, and the optimiser's memory of both."""

    primitives: BetaPrimitives
    field: MediumField
    poses: PoseCodes | None  # None where poses are held
    moments: dict[str, Moments]  # of "xyz" ..., of the field's parameters by "field.*", of the poses' by "poses.*"


@dataclass(frozen=True)
class _Round:
    """A round of densification in the middle of a step."""

    state: State
    gradients: dict[str, Tensor]
    stale: Int[Tensor, " m"]  # rows that are not what the gradient was taken of
    counts: dict[str, float]


@dataclass(frozen=True)
class Uwbs:
    """The recipe for one scene (`training.Recipe`)."""

    settings: UwbsSettings
    rec: Reconstruction
    scale: float  # working units per scene unit
    radius: float  # of the cameras' path, working units
    prior: WaterPrior | None  # None where the reconstruction has no water
    stations: Stations | None = None  # None where poses are held

    def start(self) -> State:
        """Primitives on the cloud, and the reconstruction's water in every direction."""
        settings = self.settings
        p = initial_primitives(self.rec, settings.initial, training.generator(settings.seed, 0, 2))
        if settings.dynamic:
            p = with_time(p, settings.initial, training.generator(settings.seed, 0, 5))
        p = BetaPrimitives(*(values.contiguous() for values in rescaled(p, self.scale)))
        medium = None
        if self.rec.medium is not None:
            fit = self.rec.medium.medium
            medium = Medium(fit.Binf, fit.beta_D / self.scale, fit.beta_B / self.scale)
        field = initial_field(medium, settings.medium, training.generator(settings.seed, 0, 3), settings.dynamic)
        poses = None
        if self.stations is not None:
            poses = PoseCodes(len(self.stations), settings.poses, training.generator(settings.seed, 0, 6))
        return State(p, field, poses, {name: fresh(values) for name, values in _parameters(p, field, poses).items()})

    def step(self, state: State, view: View, step: int) -> tuple[State, dict[str, float]]:
        """One view: forward, adjoint, densification on its cadence, Adam."""
        settings, share = self.settings, step / self.settings.iterations
        parameters = _parameters(state.primitives, state.field, state.poses)
        p = BetaPrimitives(*(values.detach().requires_grad_() for values in state.primitives))
        camera, filtered = view.camera, settings.sgg.enabled and share <= settings.sgg.end
        if self.stations is not None and state.poses is not None:
            place = torch.tensor([self.stations.names.index(view.name)])
            camera = replace(camera, cam2world=self.stations.moved(state.poses, place))
        sight = pinhole(camera)
        drawing = draw(p, state.field, sight, settings, view.time, sgg=filtered)
        loss = objective(p, drawing, view, settings, self.prior, self._regularised(share))
        numbers, total = loss.numbers | {"primitives": float(len(p.xyz))}, loss.total
        if self.stations is not None and state.poses is not None and share <= settings.poses.epipolar_end:
            matches = self.stations.matches.some(settings.poses.matches, training.generator(settings.seed, step, 7))
            off = self.stations.epipolar_error(state.poses, matches)
            total = total + settings.poses.epipolar * off
            numbers |= {"epipolar_px": float(off.detach())}
        leaves = [*p, *state.field.parameters(), *(state.poses.parameters() if state.poses else ())]
        multiplier = None
        if filtered:
            sgg = differentiate(total, loss.depth, leaves, p, drawing, sight, settings)
            gradients = dict(zip(parameters, sgg.gradients, strict=True))
            gradients["xyz"] = gradients["xyz"] + sgg.xyz
            multiplier = sgg.multiplier
            numbers |= {"medium_uncertainty": float(sgg.uncertainty[sgg.uncertainty > 0].mean().nan_to_num())}
        else:
            found = torch.autograd.grad(total, leaves, materialize_grads=True)
            gradients = dict(zip(parameters, found, strict=True))
        rates = self._rates(step, parameters)
        if self._densifies(step):
            round_ = self._densified(state, gradients, step, rates["xyz"])
            state, gradients = round_.state, round_.gradients
            numbers |= round_.counts
            if multiplier is not None:
                multiplier = _extended(multiplier, len(state.primitives.xyz) - len(multiplier))
                multiplier[round_.stale] = 1
        _clip_field(gradients)
        with torch.no_grad():
            parameters = _parameters(state.primitives, state.field, state.poses)
            before = None if multiplier is None else parameters["xyz"].clone()
            adam_step(parameters, gradients, state.moments, rates)
            if multiplier is not None and before is not None:
                parameters["xyz"].sub_(before).mul_(multiplier[:, None]).add_(before)
            if settings.densify.noise_cadence == "step":
                rng = training.generator(settings.seed, step, 8)
                parameters["xyz"].add_(self._noise(state.primitives, rates["xyz"], rng))
        return state, numbers

    def stored(self, state: State) -> dict[str, Tensor]:
        """Parameters by name; their moments after .first, .second and .steps."""
        parameters = _parameters(state.primitives, state.field, state.poses)
        tensors = {f"parameter.{name}": t for name, t in parameters.items()}
        for name, m in state.moments.items():
            tensors |= {f"first.{name}": m.first, f"second.{name}": m.second, f"steps.{name}": m.steps}
        return tensors

    def restored(self, tensors: dict[str, Tensor]) -> State:
        """The inverse of `stored`."""
        field = MediumField(self.settings.medium, self.settings.dynamic)
        poses = None if self.stations is None else PoseCodes(len(self.stations), self.settings.poses)
        p = BetaPrimitives(*(tensors[f"parameter.{name}"] for name in BetaPrimitives._fields))
        parameters = _parameters(p, field, poses)
        with torch.no_grad():
            for name, parameter in parameters.items():
                parameter.copy_(tensors[f"parameter.{name}"])
        moments = {k: Moments(tensors[f"first.{k}"], tensors[f"second.{k}"], tensors[f"steps.{k}"]) for k in parameters}
        return State(p, field, poses, moments)

    def _regularised(self, share: float) -> bool:
        return self.settings.weights.mcmc_begin < share <= self.settings.weights.mcmc_end

    def _every(self) -> int:
        d = self.settings.densify
        return max(d.min_every, round(d.every * self.settings.iterations))

    def _densifies(self, step: int) -> bool:
        d, share = self.settings.densify, step / self.settings.iterations
        return step % self._every() == 0 and d.begin < share <= d.end

    def _rates(self, step: int, names: Collection[str]) -> dict[str, float]:
        r, share = self.settings.rates, step / self.settings.iterations
        rates = {name: getattr(r, name) for name in BetaPrimitives._fields}
        rates["xyz"] = self.radius * log_linear(r.xyz, r.xyz_end, share)
        medium = log_linear(r.medium, r.medium_end, share)
        if self.prior is not None and share <= self.settings.medium.begin:
            medium = 0.0
        rates |= {name: medium for name in names if name.startswith(_FIELD)}
        return rates | {name: pose_rate(self.settings) for name in names if name.startswith(_POSES)}

    def _noise(self, p: BetaPrimitives, rate: float, rng: torch.Generator) -> Float[Tensor, "n 3"]:
        d = self.settings.densify
        strength = d.noise_dynamic if self.settings.dynamic else d.noise
        return densify.noise(p, strength * rate, d, self.settings.render.rotation, rng)

    def _densified(self, state: State, gradients: dict[str, Tensor], step: int, rate: float) -> _Round:
        """Relocation and growth, then noise; rows that start anew get no gradient of this step."""
        d = self.settings.densify
        n = len(state.primitives.xyz)
        growth = d.growth ** (self._every() / (d.every * self.settings.iterations))
        target = max(n, min(d.max_primitives, int(growth * n)))
        rng = training.generator(self.settings.seed, step, 4)
        with torch.no_grad():
            done = densify.relocate_and_grow(state.primitives, target, d.dead_opacity, rng)
            p = done.primitives
            if d.noise_cadence == "round":
                p = p._replace(xyz=p.xyz + self._noise(p, rate, rng))
            moments, gradients = dict(state.moments), dict(gradients)
            appended = len(p.xyz) - n
            stale = torch.cat(
                [done.restarted, (done.source != torch.arange(len(done.source))).nonzero()[:, 0]]
            ).unique()
            for name in BetaPrimitives._fields:
                m = moments[name]
                first, second = _extended(m.first, appended), _extended(m.second, appended)
                gradient = _extended(gradients[name], appended)
                first[done.restarted], second[done.restarted] = 0, 0  # as UBS: sources and copies, not the slots reused
                gradient[stale] = 0
                moments[name], gradients[name] = Moments(first, second, m.steps), gradient
        counts = {"relocated": float(done.relocated), "added": float(done.added)}
        return _Round(State(p, state.field, state.poses, moments), gradients, stale, counts)


@dataclass(frozen=True)
class Objective:
    """Eq. uwbs_total for one view."""

    total: Float[Tensor, ""]
    depth: Float[Tensor, ""]  # the depth regulariser as it stands in the total
    numbers: dict[str, float]  # the terms unweighted, for the record


def objective(
    p: BetaPrimitives,
    drawing: Drawing,
    view: View,
    settings: UwbsSettings,
    prior: WaterPrior | None,
    regularised: bool,
) -> Objective:
    """Eq. uwbs_total. Opacity and scale count only while `regularised`."""
    w = settings.weights
    photo = losses.photometric(drawing.images.rgb, view.rgb, view.seen, w.ssim)
    depth_error = losses.depth_error(drawing.images, view.z_depth, view.depth_weight, w.depth_alpha)
    smooth = smoothness(drawing.grid)
    open_share = losses.uncovered(drawing.images, view.depth_weight)
    large = losses.oversize(p, drawing.projection.radius, w.max_radius * view.camera.width / 1280)
    depth = w.depth * depth_error
    total = photo.loss + depth + w.coverage * open_share + w.medium_smoothness * smooth + w.radius * large
    numbers = {"l1": photo.l1, "ssim": photo.ssim, "depth": depth_error, "uncovered": open_share}
    numbers |= {"medium_smoothness": smooth, "radius": large}
    if prior is not None:
        off = deviation(drawing.grid, prior)
        total = total + w.medium_prior * off
        numbers |= {"medium_prior": off}
    if regularised:
        opacity, scale = losses.mean_opacity(p), losses.mean_scale(p, w.ubs_scale_reg_bug)
        total = total + w.opacity * opacity + w.scale * scale
        numbers |= {"opacity": opacity, "scale": scale}
    numbers = {"loss": total} | numbers
    return Objective(total, depth, {k: float(torch.as_tensor(v).detach()) for k, v in numbers.items()})


def train(
    rec: Reconstruction, frames: Frames, settings: UwbsSettings, folder: Path, progress: Progress = silent
) -> SplatMap:
    """Train a map in `folder`: checkpoint/, metrics.jsonl, and at the end map.safetensors and the refined cameras.json.

    Both are in the scene's own unit; cameras.json is not written where poses are held.
    """
    scale = working_scale(rec, settings)
    views = TrainingViews(rec, frames, settings, scale)
    known = None if settings.medium.model == "none" else rec.medium
    prior = None if known is None else water_prior(known, 1 / scale, settings.medium)
    stations = training_stations(rec, views.names, views.cameras, scale) if settings.poses.enabled else None
    recipe = Uwbs(settings, rec, scale, path_radius(rec, scale, settings.working_depth), prior, stations)
    final = training.run(recipe, views, _schedule(settings, rec, views), folder, progress)
    field = MediumField(settings.medium, settings.dynamic)
    field.load_state_dict(final.field.state_dict())
    field.length.fill_(1 / scale)
    primitives = BetaPrimitives(*(values.detach().clone() for values in rescaled(final.primitives, 1 / scale)))
    poses = None
    if stations is not None and final.poses is not None:
        poses = stations.refined(final.poses)
        write_refined(folder / "cameras.json", rec, poses)
    field.requires_grad_(False)
    scene = SplatMap(primitives, field, settings, rec.metric, 1 / scale, frames.span, poses)
    checkpoint.save_map(folder / "map.safetensors", scene)
    return scene


def pose_rate(settings: UwbsSettings) -> float:
    """Adam's rate for the poses: `rate` at the paper's 20,000 steps, in inverse proportion to others."""
    return min(settings.poses.largest_rate, settings.poses.rate * 20_000 / settings.iterations)


def path_radius(rec: Reconstruction, scale: float, working_depth: float) -> float:
    """1.1 times the largest distance of a camera from their mean, working units (UBS); a third of the depth at least.

    The floor keeps a camera that hardly moves from freezing its scene.
    """
    centres = rec.cameras.centres
    spread = float(torch.linalg.vector_norm(centres - centres.mean(0), dim=-1).max())
    return max(1.1 * spread * scale, working_depth / 3)


_FIELD, _POSES = "field.", "poses."


def _parameters(p: BetaPrimitives, field: MediumField, poses: PoseCodes | None = None) -> dict[str, Tensor]:
    of_field: dict[str, Tensor] = {f"{_FIELD}{name}": t for name, t in field.named_parameters()}
    of_poses = {} if poses is None else {f"{_POSES}{name}": t for name, t in poses.named_parameters()}
    return {**p._asdict(), **of_field, **of_poses}


def _extended(rows: Tensor, count: int) -> Tensor:
    return torch.cat([rows, rows.new_zeros(count, *rows.shape[1:])])


def _clip_field(gradients: dict[str, Tensor]) -> None:
    """The field's gradient is held to a norm of 1e-3 (WaterSplatting)."""
    of_field = [gradient for name, gradient in gradients.items() if name.startswith(_FIELD)]
    norm = math.hypot(*(float(g.norm()) for g in of_field))
    if norm > 1e-3:
        for g in of_field:
            g.mul_(1e-3 / norm)


def _schedule(settings: UwbsSettings, rec: Reconstruction, views: TrainingViews) -> training.Schedule:
    everything = [asdict(settings), views.names, views.times, rec.cameras.cam2world.tolist(), rec.cameras.K.tolist()]
    if settings.poses.enabled:
        everything.append(float(rec.matches.xy_i.double().sum() + rec.matches.xy_j.double().sum()))
    digest = hashlib.sha256(json.dumps(everything, sort_keys=True).encode()).hexdigest()[:16]
    return training.Schedule(
        iterations=settings.iterations,
        log_every=max(1, math.ceil(settings.log_every * settings.iterations)),
        checkpoint_every=max(1, math.ceil(settings.checkpoint_every * settings.iterations)),
        seed=settings.seed,
        fingerprint=digest,
    )
