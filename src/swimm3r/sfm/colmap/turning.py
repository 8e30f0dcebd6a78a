"""The turn of the camera while the rows of each frame were exposed, from the tracks alone.

`rolling_shutter` knows a camera's motion from the path between frames. Where frames are a second apart, or stills, each
has a motion of its own: the rotation vector w within the exposure of a frame (`imaging.turned_rows`). Poses, points and
turns are adjusted together,

    sum rho(|pi(R_f X_p + t_f) - pi(exp((y / H - 1/2) w_f) d_o)|^2 / sigma^2) + sum |w_f|^2 / sigma_w^2

with d_o the ray of observation o in row y, rho COLMAP's soft L1 and pi the division by depth, in pixels. sigma_w holds
back what tracks hardly determine: a turn that all frames share looks like another lens. A fifth of the observations is
held out and judges: turns are believed where they bring these clearly closer.
"""

import logging
import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.optimize import least_squares
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation
from torch import Tensor

from swimm3r.cameras import Cameras, directions, rows_of_frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.rectified_rows import RowTurns

_STD = 0.002  # rad within a frame, of turns: 20 ms at 6 degrees per second
_CLEARLY = 0.95  # of the median held-out error, below which turns are believed
_HELD_OUT = 0.2  # of the observations of points that enough others show
_ENOUGH = 3  # observations of a point that are left
_FEWEST = 500  # held-out observations that can judge
_FEWEST_FRAMES = 6
_STRETCH, _MOST = 200, 40_000  # frames that are adjusted at once, and their observations that are looked at
_STEPS, _SETTLED = 12, 1e-4  # of Levenberg-Marquardt, and the relative fall of the sum that ends it
_WIDTHS = (0.05, 1.0)  # px, least and largest sigma
_LEAST = 1e-9  # weight with which each unknown stays: that of frames and points without observations

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Observations:
    """Rays of observations on the plane z = 1, with the points, frames and rows they are of."""

    point: Int[np.ndarray, " o"]
    frame: Int[np.ndarray, " o"]
    ray: Float[np.ndarray, "o 3"]
    row: Float[np.ndarray, " o"]  # y / H - 1/2

    def some(self, chosen: Bool[np.ndarray, " o"]) -> "_Observations":
        return _Observations(*(part[chosen] for part in vars(self).values()))


@dataclass(frozen=True)
class _State:
    """The unknowns of the adjustment."""

    R: Float[np.ndarray, "n 3 3"]  # world to camera
    t: Float[np.ndarray, "n 3"]
    xyz: Float[np.ndarray, "p 3"]
    turn: Float[np.ndarray, "n 3"]


@dataclass(frozen=True)
class _Problem:
    """The sum that is to become least."""

    observed: _Observations
    focal: float  # px
    sigma: float  # px

    def errors(self, state: _State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Reprojection errors [o, 2] in pixels, points in camera axes [o, 3] and rays of half time [o, 3]."""
        o = self.observed
        seen = np.einsum("nij,nj->ni", state.R[o.frame], state.xyz[o.point]) + state.t[o.frame]
        ray = Rotation.from_rotvec(o.row[:, None] * state.turn[o.frame]).apply(o.ray)
        return self.focal * (seen[:, :2] / seen[:, 2:] - ray[:, :2] / ray[:, 2:]), seen, ray

    def total(self, state: _State) -> float:
        squared = np.square(self.errors(state)[0] / self.sigma).sum(-1)
        return float(2 * (np.sqrt(1 + squared) - 1).sum() + np.square(state.turn / _STD).sum())


def turned_rows(rec: Reconstruction) -> RowTurns | None:
    """The turns of a reconstruction's frames; None where held-out observations do not show that its camera turned.

    All frames are of one lens, whose poses and points are as adjusted without turns. Of long clips stretches of frames
    are adjusted one by one. A fisheye's rays have no places on a plane, and are not asked.
    """
    n = len(rec.names)
    if n < _FEWEST_FRAMES or rec.cameras.model == "OPENCV_FISHEYE":
        return None
    observed, start, focal, sigma = _observations(rec), _start(rec), rec.cameras.K[0, 0, 0].item(), _sigma(rec)
    stretches = np.array_split(np.arange(n), math.ceil(n / _STRETCH))
    parts = [_stretch(observed, start, int(frames[0]), int(frames[-1]) + 1) for frames in stretches]
    errors: tuple[list[np.ndarray], list[np.ndarray]] = [], []
    turning = []
    for part, state in parts:
        held_out = _held_out(part.point)
        fitted, judge = (_Problem(part.some(which), focal, sigma) for which in (~held_out, held_out))
        states = [_adjusted(fitted, state, turns=turns) for turns in (False, True)]
        for found, off in zip(states, errors, strict=True):
            off.append(np.linalg.norm(judge.errors(found)[0], axis=-1))
        turning.append(states[1])
    without, with_turns = (np.concatenate(off) for off in errors)
    if len(without) < _FEWEST:
        return None
    before, after = float(np.median(without)), float(np.median(with_turns))
    log.info("rows exposed while the camera turned: held-out observations %.3f px off, %.3f without", after, before)
    if not after <= _CLEARLY * before:  # also where one of them is no number
        return None
    every = [
        _adjusted(_Problem(part, focal, sigma), state, turns=True)
        for (part, _), state in zip(parts, turning, strict=True)
    ]
    lens = replace(rec.cameras[0], cam2world=torch.eye(4, dtype=torch.float64)[None])
    return RowTurns(lens, dict(zip(rec.names, np.concatenate([state.turn for state in every]), strict=True)))


def turned_pose(
    camera: Cameras, xy: Float[Tensor, "k 2"], xyz: Float[Tensor, "k 3"]
) -> tuple[Float[Tensor, "4 4"], Float[np.ndarray, "3"]]:
    """Pose and turn of one camera near where it is that show points of the world in pixels as filmed."""
    rays = directions(camera, xy.double()[None])[0].numpy()
    frame, point = np.zeros(len(rays), dtype=np.int64), np.arange(len(rays))
    row = (xy[:, 1].double() / camera.height - 0.5).numpy()
    world2cam = camera.world2cam[0].double().numpy()
    start = _State(world2cam[None, :3, :3], world2cam[None, :3, 3], xyz.double().numpy(), np.zeros((1, 3)))
    problem = _Problem(_Observations(point, frame, rays, row), camera.K[0, 0, 0].item(), _WIDTHS[1])

    def moved(change: np.ndarray) -> _State:
        R = Rotation.from_rotvec(change[:3]).as_matrix() @ start.R
        return replace(start, R=R, t=start.t + change[3:6], turn=change[None, 6:])

    def residuals(change: np.ndarray) -> np.ndarray:
        errors = problem.errors(moved(change))[0] / problem.sigma
        robust = np.sqrt(2 * (np.sqrt(1 + np.square(errors).sum(-1)) - 1))
        return np.concatenate([robust, change[6:] / _STD])

    change = np.zeros(9)
    for _ in range(2):  # the second time with the width of the errors that are left
        change = least_squares(residuals, change, method="lm").x
        error = np.linalg.norm(problem.errors(moved(change))[0], axis=-1)
        problem = replace(problem, sigma=float(np.clip(np.median(error), *_WIDTHS)))
    found = moved(change)
    cam2world = torch.eye(4, dtype=torch.float64)
    cam2world[:3, :3] = torch.from_numpy(found.R[0].T)
    cam2world[:3, 3] = torch.from_numpy(-found.R[0].T @ found.t[0])
    return cam2world, found.turn[0]


def _start(rec: Reconstruction) -> _State:
    cam2world = rec.cameras.cam2world.double().numpy()
    R = np.swapaxes(cam2world[:, :3, :3], 1, 2).copy()
    t = -np.einsum("nij,nj->ni", R, cam2world[:, :3, 3])
    return _State(R, t, rec.points.xyz.double().numpy(), np.zeros((len(R), 3)))


def _sigma(rec: Reconstruction) -> float:
    """Median error of the points, px."""
    return float(np.clip(np.nanmedian(rec.points.error.double().numpy()), *_WIDTHS))


def _observations(rec: Reconstruction) -> _Observations:
    tracks = rec.tracks
    rays = torch.full((len(tracks.point), 3), torch.nan, dtype=torch.float64)
    for i, rows in enumerate(rows_of_frames(tracks.frame, len(rec.names))):
        rays[rows] = directions(rec.cameras[i], tracks.xy[rows].double()[None])[0]
    row = tracks.xy[:, 1].double() / rec.cameras.height - 0.5
    found = _Observations(tracks.point.numpy(), tracks.frame.numpy(), rays.numpy(), row.numpy())
    return found.some(np.asarray(np.isfinite(found.ray).all(-1)))


def _stretch(observed: _Observations, state: _State, first: int, end: int) -> tuple[_Observations, _State]:
    """Frames `first` to `end` - 1 alone, with the points that two of them show, or as many as make few enough."""
    mine = observed.some((observed.frame >= first) & (observed.frame < end))
    count = np.bincount(mine.point, minlength=len(state.xyz))
    order = np.random.default_rng(0).permutation(len(count))
    order = order[count[order] > 1]
    chosen = np.zeros(len(count), dtype=bool)
    chosen[order[: np.searchsorted(count[order].cumsum(), _MOST)]] = True
    mine = mine.some(chosen[mine.point])
    new = chosen.cumsum() - 1
    own = _State(state.R[first:end], state.t[first:end], state.xyz[chosen], state.turn[first:end])
    return replace(mine, point=new[mine.point], frame=mine.frame - first), own


def _held_out(point: Int[np.ndarray, " o"]) -> Bool[np.ndarray, " o"]:
    chosen = np.random.default_rng(0).random(len(point)) < _HELD_OUT
    left = np.bincount(point[~chosen], minlength=point.max(initial=0) + 1)
    return chosen & (left[point] >= _ENOUGH)


def _adjusted(problem: _Problem, state: _State, *, turns: bool) -> _State:
    """The state of the least sum near this one, by Levenberg and Marquardt's method."""
    damping, total = 1e-4, problem.total(state)
    for _ in range(_STEPS):
        equations = _Equations.of(problem, state, turns=turns)
        while True:
            trial = equations.step(state, damping)
            new = problem.total(trial)
            if new < total or damping > 1:
                break
            damping *= 10
        if not new < total:
            return state
        settled = total - new < _SETTLED * total
        state, total, damping = trial, new, max(damping / 10, 1e-9)
        if settled:
            return state
    return state


@dataclass(frozen=True)
class _Equations:
    """Normal equations [[A, B], [B^T, C]] of cameras and points, blocks alone."""

    A: Float[np.ndarray, "n k k"]
    B: Float[np.ndarray, "o k 3"]
    C: Float[np.ndarray, "p 3 3"]
    of_cameras: Float[np.ndarray, "n k"]  # right-hand sides
    of_points: Float[np.ndarray, "p 3"]
    observed: _Observations

    @classmethod
    def of(cls, problem: _Problem, state: _State, *, turns: bool) -> "_Equations":
        """Those about a state: rotations and places of cameras, and turns where asked, change in their own axes."""
        o = problem.observed
        e, seen, ray = problem.errors(state)
        weight = 1 / (problem.sigma**2 * np.sqrt(1 + np.square(e / problem.sigma).sum(-1)))
        to_pixels = _divided(seen, problem.focal)
        by_camera = [-to_pixels @ _cross(seen - state.t[o.frame]), to_pixels]
        if turns:
            by_camera.append(o.row[:, None, None] * (_divided(ray, problem.focal) @ _cross(ray)))
        J, P = np.concatenate(by_camera, -1), to_pixels @ state.R[o.frame]
        cameras, points = len(state.R), len(state.xyz)
        A = _summed(np.einsum("oij,oik,o->ojk", J, J, weight), o.frame, cameras)
        of_cameras = _summed(-np.einsum("oij,oi,o->oj", J, e, weight), o.frame, cameras)
        if turns:
            A[:, range(6, 9), range(6, 9)] += 1 / _STD**2
            of_cameras[:, 6:] -= state.turn / _STD**2
        return cls(
            A,
            np.einsum("oij,oik,o->ojk", J, P, weight),
            _summed(np.einsum("oij,oik,o->ojk", P, P, weight), o.point, points),
            of_cameras,
            _summed(-np.einsum("oij,oi,o->oj", P, e, weight), o.point, points),
            o,
        )

    def step(self, state: _State, damping: float) -> _State:
        """The state that the damped equations lead to, points eliminated first (Schur's complement)."""
        n, k = self.of_cameras.shape
        A = self.A + damping * _diagonal(self.A) + _LEAST * np.eye(k)
        C = np.linalg.inv(self.C + damping * _diagonal(self.C) + _LEAST * np.eye(3))
        frame, point = self.observed.frame, self.observed.point
        rows = np.broadcast_to(frame[:, None, None] * k + np.arange(k)[:, None], self.B.shape)
        columns = np.broadcast_to(point[:, None, None] * 3 + np.arange(3), self.B.shape)
        B = sparse.csr_matrix((self.B.ravel(), (rows.ravel(), columns.ravel())), shape=(n * k, 3 * len(C)))
        BC = B @ _block_diagonal(C)
        reduced = (_block_diagonal(A) - BC @ B.T).tocsc()
        cameras = splu(reduced).solve(self.of_cameras.ravel() - BC @ self.of_points.ravel())
        points = np.einsum("pij,pj->pi", C, self.of_points - (B.T @ cameras).reshape(-1, 3))
        cameras = cameras.reshape(n, k)
        R = Rotation.from_rotvec(cameras[:, :3]).as_matrix() @ state.R
        turn = state.turn + cameras[:, 6:] if k > 6 else state.turn
        return _State(R, state.t + cameras[:, 3:6], state.xyz + points, turn)


def _summed(parts: np.ndarray, into: Int[np.ndarray, " o"], count: int) -> np.ndarray:
    sums = np.zeros((count, *parts.shape[1:]))
    np.add.at(sums, into, parts)
    return sums


def _diagonal(blocks: Float[np.ndarray, "n k k"]) -> Float[np.ndarray, "n k k"]:
    return np.einsum("nii->ni", blocks)[:, :, None] * np.eye(blocks.shape[-1])


def _block_diagonal(blocks: Float[np.ndarray, "n k k"]) -> sparse.csr_matrix:
    n, k = blocks.shape[:2]
    return sparse.csr_matrix(sparse.bsr_matrix((blocks, np.arange(n), np.arange(n + 1)), shape=(n * k, n * k)))


def _divided(seen: Float[np.ndarray, "o 3"], focal: float) -> Float[np.ndarray, "o 2 3"]:
    """Derivative of focal (x / z, y / z)."""
    z = seen[:, 2]
    out = np.zeros((len(z), 2, 3))
    out[:, 0, 0] = out[:, 1, 1] = focal / z
    out[:, :, 2] = -focal * seen[:, :2] / z[:, None] ** 2
    return out


def _cross(v: Float[np.ndarray, "o 3"]) -> Float[np.ndarray, "o 3 3"]:
    """Matrices of the products with these vectors."""
    out = np.zeros((len(v), 3, 3))
    out[:, 2, 1], out[:, 0, 2], out[:, 1, 0] = v.T
    return out - np.swapaxes(out, 1, 2)
