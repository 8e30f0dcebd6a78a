"""Sparse global alignment: poses, focals and block depths that make matched pixels meet (MASt3R-SfM, sec. 3.3).

    frame i:  scale s_i, focal f_i, principal point c_i, block depths d; m_i, f0_i: its median depth and own first focal
    focal plane  z_i = s_i m_i f_i / f0_i;     block depth  D = g (z_i + (d - 1) m_i s_i),   g = 1 / min s
    pose         R_i, center = g (t_i - R_i o_i),   o_i = z_i (((W/2, H/2) - c_i) / f_i, 1)
    pixel p of a block  X = pose_i (D * (1 + (r(p) - 1) f0 / f) * K^-1 (p, 1)),   r(p): its relative depth

    coarse:  sum c l_1.5(X_i - X_j) / sum c                       over matches with confidence c
    fine:    sum c l_0.5(p_i - project_i(X_j)) / sum c            both ways
    l_gamma(r) = (r + delta)^gamma - delta^gamma,  delta = (1/gamma)^(1/(gamma-1)), so that l'(0) = 1

t_i is the point of the scene before the frame's center, which turns with less effect than the camera would: that is why
it is the parameter. All frames are computed at once, ragged in flat arrays; nothing loops over frames in a step.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.errors import RegistrationError
from swimm3r.geometry import quaternion_from_rotation, rotation_from_quaternion
from swimm3r.progress import Progress, silent
from swimm3r.sfm.alignment.canonical import AnchoredFrame
from swimm3r.sfm.alignment.kinematic_tree import compose
from swimm3r.sfm.alignment.problem import AlignmentProblem, AnchoredPair, Known
from swimm3r.sfm.mast3r.settings import AlignmentSettings

_NEAREST = 1e-3  # z at which a projection is cut off
_VISIBLE = (-1000.0, 2000.0)  # pixels a projection is clipped to: beyond, gradients only say "far away"
_FALLBACK_WEIGHT = 0.01
_FOCAL_RANGE = (0.25, 10.0)  # of the image's diagonal


@dataclass(frozen=True)
class Alignment:
    """Cameras and block depths of all frames, in the unit of the least scaled frame (the network's metres)."""

    K: Float[Tensor, "n 3 3"]  # float64, pixels of the network's image, centers at +0.5
    cam2world: Float[Tensor, "n 4 4"]  # float64
    anchor_z_depth: tuple[Float[Tensor, " _"], ...]  # per frame
    focal_before: Float[Tensor, " n"]  # the pointmaps' own: `dense_z_depth` needs it
    points: Float[Tensor, "m 3"]  # of all matches in the order of the pairs, the middle between both frames' opinions
    losses: tuple[Float[Tensor, " coarse"], Float[Tensor, " fine"]]


def align(
    frames: Sequence[AnchoredFrame],
    pairs: Sequence[AnchoredPair],
    settings: AlignmentSettings = AlignmentSettings(),  # noqa: B008  frozen
    known: Known = Known(),  # noqa: B008  frozen
    progress: Progress = silent,
) -> Alignment:
    """Aligns n frames through their matches; each unordered pair once.

    Raises RegistrationError where nothing matches or the frames fall into groups without a match between them, and
    UsageError where the settings need intrinsics that are not known.
    """
    problem = AlignmentProblem.of(frames, pairs, settings, known)
    parameters = _Parameters.initial(problem, settings, known)
    coarse = _optimize("coarse alignment", parameters.pose(), problem, parameters, settings, progress)
    fine_set = [*parameters.pose(), *parameters.camera(settings)]
    fine = _optimize("fine alignment", fine_set, problem, parameters, settings, progress)
    last = fine if len(fine.losses) else coarse
    with torch.no_grad():
        scene = last.scene if settings.parity and last.scene is not None else _scene(parameters, problem, settings)
        points = _points(scene, problem).unflatten(0, (2, -1)).mean(0)
    K = scene.K.detach().double()
    K[:, :2, 2] += 0.5 - problem.pixel_center
    cam2world = torch.eye(4, dtype=torch.float64).repeat(len(frames), 1, 1)
    cam2world[:, :3, :3], cam2world[:, :3, 3] = scene.R.detach().double(), scene.center.detach().double()
    depths = scene.depth.detach().split([len(f.anchor_depth) for f in frames])
    return Alignment(K, cam2world, tuple(depths), problem.focal, points, (coarse.losses, fine.losses))


def dense_z_depth(
    anchor_z_depth: Float[Tensor, " a"],
    relative_depth: Float[Tensor, "h w"],
    focal_before: float,
    focal: float,
    subsample: int = 8,
) -> Float[Tensor, "h w"]:
    """z depth of every pixel: its block's, shaped as in the canonical view and stretched with the focal length."""
    h, w = relative_depth.shape
    blocks = anchor_z_depth.unflatten(0, (h // subsample, w // subsample))
    spread = blocks.repeat_interleave(subsample, 0).repeat_interleave(subsample, 1)
    return spread * (1 + (relative_depth - 1) * focal_before / focal)


def robust(r: Float[Tensor, "*m"], gamma: float) -> Float[Tensor, "*m"]:
    """l_gamma of residual lengths: slope 1 at 0, growing as r^gamma."""
    if gamma == 1:
        return r
    delta = (1 / gamma) ** (1 / (gamma - 1))
    return (r + delta) ** gamma - delta**gamma


@dataclass(frozen=True)
class _Parameters:
    quaternion: Tensor  # n 4, wxyz, relative to the parent
    translation: Tensor  # n 3
    log_size: Tensor  # n
    log_focal: Tensor  # n, or 1 if shared
    principal: Tensor  # n 2 (or 1 2), in image sizes
    depth: Tensor  # a

    @staticmethod
    def initial(problem: AlignmentProblem, settings: AlignmentSettings, known: Known) -> "_Parameters":
        n = len(problem.focal)
        shared = settings.intrinsics == "shared"
        principal = torch.full((n, 2), 0.5)
        if problem.known_K is not None:
            principal = problem.known_K[:, :2, 2] / problem.size
        depth = problem.anchor_ratio.clone()
        quaternion, translation = torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), torch.zeros(n, 3)
        if problem.known_pose is not None:
            quaternion, translation = _relative_to_parents(problem, principal)
        values = (
            quaternion,
            translation,
            torch.zeros(n),
            (problem.start_focal[:1] if shared else problem.start_focal).log(),
            principal[:1] if shared else principal,
            depth.clamp(min=1e-4).log() if settings.exponential_depth else depth,
        )
        return _Parameters(*(v.clone().requires_grad_() for v in values))

    def pose(self) -> list[Tensor]:
        return [self.quaternion, self.translation, self.log_size]

    def camera(self, settings: AlignmentSettings) -> list[Tensor]:
        """The unknowns that the fine phase adds."""
        chosen = []
        if settings.intrinsics != "fixed":
            chosen.append(self.log_focal)
            if settings.optimize_principal_point:
                chosen.append(self.principal)
        if settings.optimize_depth:
            chosen.append(self.depth)
        return chosen


@dataclass(frozen=True)
class _Scene:
    """The cameras and depths some parameters mean."""

    K: Tensor  # n 3 3
    R: Tensor  # n 3 3, camera to world
    center: Tensor  # n 3
    depth: Tensor  # a


@dataclass(frozen=True)
class _Phase:
    losses: Tensor
    scene: _Scene | None  # of the forward pass before the last step


def _scene(parameters: _Parameters, problem: AlignmentProblem, settings: AlignmentSettings) -> _Scene:
    n = len(problem.focal)
    diagonal = problem.size.norm(dim=1)
    low, high = (factor * diagonal for factor in _FOCAL_RANGE)
    focal = torch.minimum(torch.maximum(parameters.log_focal.exp().expand(n), low), high)
    principal = parameters.principal.expand(n, 2)
    K = torch.zeros(n, 3, 3)
    K[:, 0, 0], K[:, 1, 1], K[:, 2, 2] = focal, focal * problem.aspect, 1
    K[:, :2, 2] = principal * problem.size

    size = parameters.log_size.exp()
    # Two known camera centers settle the scale; else it is held by the least scaled frame.
    unit = torch.ones(()) if int(problem.posed.sum()) >= 2 else 1 / size.min()
    plane = size * problem.median * focal / problem.focal
    offset = _focal_point(plane, focal, principal, problem)

    quaternion, translation = parameters.quaternion, parameters.translation
    if not settings.parity and problem.known_pose is None:  # the root is the gauge: it stays
        fixed = torch.arange(n) == problem.tree.root
        quaternion = torch.where(fixed[:, None], quaternion.detach(), quaternion)
        translation = torch.where(fixed[:, None], translation.detach(), translation)
    R, t = compose(problem.tree, rotation_from_quaternion(quaternion), translation)
    center = unit * (t - (R @ offset[..., None])[..., 0])
    if problem.known_pose is not None:
        R = torch.where(problem.posed[:, None, None], problem.known_pose[:, :3, :3], R)
        center = torch.where(problem.posed[:, None], problem.known_pose[:, :3, 3], center)

    ratio = parameters.depth.exp() if settings.exponential_depth else parameters.depth
    at = problem.anchor_frame
    added = plane[at] + (ratio - 1) * (problem.median * size)[at]
    return _Scene(K, R, center, unit * (added if settings.depth == "add" else plane[at] * ratio))


def _points(scene: _Scene, problem: AlignmentProblem) -> Float[Tensor, "p 3"]:
    """Every matched pixel in the world."""
    at = problem.point_frame
    focal = scene.K[:, 0, 0]
    relative = 1 + (problem.point_relative - 1) * (problem.focal / focal)[at]
    z = scene.depth[problem.point_anchor] * relative
    plane = (problem.point_xy - scene.K[at, :2, 2]) / scene.K[:, [0, 1], [0, 1]][at]
    seen = torch.cat([plane, torch.ones_like(plane[:, :1])], dim=1) * z[:, None]
    return (scene.R[at] @ seen[..., None])[..., 0] + scene.center[at]


def _loss(scene: _Scene, problem: AlignmentProblem, fine: bool) -> Tensor:
    points = _points(scene, problem)
    confidence = problem.match_confidence
    total = confidence.sum().clamp(min=1e-8)
    half = len(confidence)
    if fine:
        other = torch.cat([points[half:], points[:half]])
        at = problem.point_frame
        seen = (scene.R[at].mT @ (other - scene.center[at])[..., None])[..., 0]
        pixel = (scene.K[at] @ seen[..., None])[..., 0]
        pixel = (pixel[:, :2] / seen[:, 2:].clamp(min=_NEAREST)).clamp(*_VISIBLE)
        residual = robust(_length(problem.point_xy - pixel), 0.5).unflatten(0, (2, half)).sum(0)
        loss = (confidence * residual).sum() / (2 * total)
    else:
        loss = (confidence * robust(_length(points[:half] - points[half:]), 1.5)).sum() / total
    if len(problem.failed_point):
        at = problem.failed_frame
        target = (scene.R[at] @ problem.failed_target[..., None])[..., 0] + scene.center[at]
        residual = robust(_length(points[problem.failed_point] - target), 1.1)
        weight = problem.failed_confidence
        loss = loss + _FALLBACK_WEIGHT * (weight * residual).sum() / weight.sum()
    return loss


def _prior(parameters: _Parameters, problem: AlignmentProblem) -> Tensor:
    assert problem.known_K is not None
    focal = parameters.log_focal - problem.focal.log()
    principal = parameters.principal - problem.known_K[:, :2, 2] / problem.size
    return (focal**2).mean() + (principal**2).sum(1).mean()


def _optimize(
    phase: str,
    trainable: list[Tensor],
    problem: AlignmentProblem,
    parameters: _Parameters,
    settings: AlignmentSettings,
    progress: Progress,
) -> _Phase:
    """Adam with a cosine from the phase's rate to 0, in place on the parameters."""
    fine = phase.startswith("fine")
    iterations = settings.fine_iterations if fine else settings.coarse_iterations
    rate = settings.fine_rate if fine else settings.coarse_rate
    optimizer = torch.optim.Adam(trainable, lr=rate, betas=(0.9, 0.9))
    losses, scene = [], None
    for it in range(iterations):
        progress(phase, it, iterations)
        for group in optimizer.param_groups:
            group["lr"] = rate * (1 + math.cos(math.pi * it / iterations)) / 2
        optimizer.zero_grad()
        scene = _scene(parameters, problem, settings)
        loss = _loss(scene, problem, fine)
        if fine and settings.intrinsics == "prior":
            loss = loss + settings.prior_weight * _prior(parameters, problem)
        losses.append(loss.detach())
        if not torch.isfinite(loss):
            raise RegistrationError(
                f"the {phase} diverged at iteration {it + 1} of {iterations}",
                cause="the matches contradict each other, or the intrinsics are far off",
                hint="more overlap between frames, or known intrinsics",
            )
        loss.backward()
        optimizer.step()
        with torch.no_grad():
            parameters.quaternion.div_(parameters.quaternion.norm(dim=1, keepdim=True))
    progress(phase, iterations, iterations)
    return _Phase(torch.stack(losses) if losses else torch.zeros(0), scene)


def _relative_to_parents(problem: AlignmentProblem, principal: Tensor) -> tuple[Tensor, Tensor]:
    """Chained parameters that give the known poses; a frame without one starts where its parent is."""
    pose = problem.known_pose
    assert pose is not None
    plane = problem.median * problem.start_focal / problem.focal
    offset = _focal_point(plane, problem.start_focal, principal, problem)
    n = len(problem.focal)
    R, t = torch.eye(3).repeat(n, 1, 1), torch.zeros(n, 3)
    posed = problem.posed.tolist()
    first = next((f for f in problem.tree.order if posed[f]), None)
    for f in problem.tree.order:
        parent = int(problem.tree.parent[f])
        source = f if posed[f] else (first if f == problem.tree.root else None)
        if source is not None:
            R[f] = pose[source, :3, :3]
            t[f] = pose[source, :3, 3] + R[f] @ offset[f]
        else:
            R[f], t[f] = R[parent], t[parent]
    up = problem.tree.parent
    root = torch.arange(n) == problem.tree.root
    relative_R = torch.where(root[:, None, None], R, R[up].mT @ R)
    relative_t = torch.where(root[:, None], t, (R[up].mT @ (t - t[up])[..., None])[..., 0])
    return quaternion_from_rotation(relative_R), relative_t


def _focal_point(plane: Tensor, focal: Tensor, principal: Tensor, problem: AlignmentProblem) -> Tensor:
    """The point before the middle of each image, at the focal plane, in the camera."""
    scale = torch.stack([focal, focal * problem.aspect], dim=1)
    return plane[:, None] * torch.cat([problem.size / scale * (0.5 - principal), torch.ones(len(plane), 1)], dim=1)


def _length(x: Tensor) -> Tensor:
    return torch.linalg.vector_norm(x, dim=-1)
