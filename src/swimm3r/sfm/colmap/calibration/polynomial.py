"""The lens of a clip as a polynomial, where no model of COLMAP's explains its images.

Poses, points and the lens (`cameras`, POLYNOMIAL) are adjusted together by damped Gauss-Newton under a Soft-L1 loss,

    sum 2 c^2 (sqrt(1 + |e|^2 / c^2) - 1),    c = 0.5 px,

points eliminated as in any bundle adjustment (Triggs et al. 2000, section 6). COLMAP's adjustment has no such lens,
and shifting observations in turn with it (`rolling_shutter`) does not get there: poses take up most of the bend.

A polynomial of 40 numbers fits its own observations better than a lens of 4. So one observation of each longer track is
left out of all adjustments, and their median error decides, first against the lens that there is, then by degree.
"""

import logging
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.spatial.transform import Rotation

from swimm3r.cameras import DISTORTION_PARAMETERS, EXPONENTS, Cameras
from swimm3r.progress import Progress, silent

if TYPE_CHECKING:
    import pycolmap

_WIDTH = 0.5  # px, c above
_GOOD = 0.25  # px; where observations are off by less there is nothing to explain
_LEAST_FRAMES = 6
_LEAST_HELD = 100  # observations left out, below which their median says little
_FEW, _MOST = 6_000, 30_000  # observations that are adjusted, on trial and then; of more, those of some points
_LONG = 5  # observations of a track of which one is left out
_TRIAL = 8  # steps on trial
_TURNS = 60  # steps at most
_TRIED = 0.8  # of the held-out error, to go on after the trial: models' clips have 0.94 to 1.08, bent ones 0.43 to 0.60
_BETTER = 0.8  # of the held-out error, for the polynomial to be the lens
_NEXT = 0.97  # of the held-out error, for its higher degree
_CONVERGED = 1e-4  # share of the cost by which a step lowers it
_DAMPING = 1e-3

_STEP = "lens beyond models"

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Observations:
    """Observed pixels of points in frames; those held out are adjusted to nothing."""

    frame: Int[np.ndarray, " m"]
    point: Int[np.ndarray, " m"]
    xy: Float[np.ndarray, "m 2"]
    held: Bool[np.ndarray, " m"]


@dataclass(frozen=True)
class _State:
    """Poses, points and lens: u = f (x + sum a_ij x^i y^j) + c, with (x, y) on the plane z = 1."""

    rotation: Float[np.ndarray, "n 3 3"]  # world to camera
    translation: Float[np.ndarray, "n 3"]
    points: Float[np.ndarray, "p 3"]
    K: Float[np.ndarray, "4"]  # fx, fy, cx, cy
    bend: Float[np.ndarray, "2 t"]


def bent_lens(model: "pycolmap.Reconstruction", progress: Progress) -> Cameras | None:
    """The lens of a model's only camera as a POLYNOMIAL in its pixels; None where its own model explains the images
    about as well, or is a fisheye, or where there are too few frames and observations to tell.
    """
    if len(model.reg_image_ids()) < _LEAST_FRAMES:
        return None
    progress(_STEP, 0, 4)
    start, seen = _start(model, _FEW)
    hopeful = start is not None and seen.held.sum() >= _LEAST_HELD and _gains(start, seen)
    progress(_STEP, 1, 4)
    start, seen = _start(model, _MOST) if hopeful else (None, seen)
    best = None if start is None else _fitted(start, seen, progress)
    progress(_STEP, 4, 4)
    return None if best is None else _lens_of(best, model)


def _gains(start: _State, seen: _Observations) -> bool:
    """Return whether a few steps with a polynomial explain observations left out that as many without do not."""
    if np.median(_errors(start, seen)) < _GOOD:
        return False
    held, bent = (_adjusted(start, seen, degree, _TRIAL) for degree in (0, 3))
    return _held_error(bent, seen) < _TRIED * _held_error(held, seen)


def errors_left_out(model: "pycolmap.Reconstruction", progress: Progress = silent) -> dict[int, float] | None:
    """Median error of observations left out, px, under a model's own lens (0) and polynomials by their degree; None of
    a fisheye.
    """
    start, seen = _start(model, _MOST)
    if start is None:
        return None
    return {degree: _held_error(state, seen) for degree, state in _by_degree(start, seen, progress).items()}


def _by_degree(start: _State, seen: _Observations, progress: Progress) -> dict[int, _State]:
    """The state with its lens held, and adjusted with polynomials of degree 3 and 5."""
    states = {0: _adjusted(start, seen, 0)}
    for done, (before, degree) in enumerate(((0, 3), (3, 5)), 2):
        states[degree] = _adjusted(states[before], seen, degree)
        progress(_STEP, done, 4)
    return states


def _fitted(start: _State, seen: _Observations, progress: Progress) -> _State | None:
    """The state with the lens that explains observations left out; None where that is the one that there is."""
    states = _by_degree(start, seen, progress)
    errors = {degree: _held_error(state, seen) for degree, state in states.items()}
    told = ", ".join(f"{error:.3f} px under degree {degree}" for degree, error in errors.items())
    log.info("error of observations left out, under the lens as degree 0: %s", told)
    best = 5 if errors[5] < _NEXT * errors[3] else 3
    return states[best] if errors[best] < _BETTER * errors[0] else None


def _start(model: "pycolmap.Reconstruction", most: int) -> tuple[_State | None, _Observations]:
    """A model as it is adjusted, and its observations; no state of a fisheye."""
    images = [model.images[i] for i in sorted(model.reg_image_ids())]
    number = {image.image_id: k for k, image in enumerate(images)}
    rng = np.random.default_rng(0)
    tracks = [point.track.elements for point in model.points3D.values()]
    xyz = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    share = most / max(1, sum(len(track) for track in tracks))
    chosen = [k for k in range(len(tracks)) if len(tracks[k]) > 2 and rng.random() < share]
    frame, point, xy, held = [], [], [], []
    for new, k in enumerate(chosen):
        out = rng.integers(len(tracks[k])) if len(tracks[k]) >= _LONG else -1
        for j, element in enumerate(tracks[k]):
            frame.append(number[element.image_id])
            point.append(new)
            xy.append(model.images[element.image_id].points2D[element.point2D_idx].xy)
            held.append(j == out)
    seen = _Observations(
        np.array(frame, np.int64), np.array(point, np.int64), np.array(xy).reshape(-1, 2), np.array(held, bool)
    )
    lens = _as_polynomial(model.cameras[images[0].camera_id])
    if lens is None:
        return None, seen
    poses = [image.cam_from_world() for image in images]
    rotation = np.array([pose.rotation.matrix() for pose in poses])
    translation = np.array([pose.translation for pose in poses])
    return _State(rotation, translation, xyz[chosen], *lens), seen


def _as_polynomial(camera: "pycolmap.Camera") -> tuple[Float[np.ndarray, "4"], Float[np.ndarray, "2 t"]] | None:
    """K and coefficients with which POLYNOMIAL is a lens of COLMAP's."""
    params = list(camera.params)
    match camera.model.name:
        case "SIMPLE_RADIAL":
            K, (k1, k2, p1, p2) = [params[0], *params[:3]], (params[3], 0.0, 0.0, 0.0)
        case "OPENCV":
            K, (k1, k2, p1, p2) = params[:4], params[4:]
        case _:
            return None
    bend = np.zeros((2, len(EXPONENTS)))

    def add(axis: int, i: int, j: int, value: float) -> None:
        bend[axis, EXPONENTS.index((i, j))] += value

    for axis, (i, j) in enumerate(((1, 0), (0, 1))):
        for twice_x, twice_y, value in ((1, 0, k1), (0, 1, k1), (2, 0, k2), (1, 1, 2 * k2), (0, 2, k2)):
            add(axis, 2 * twice_x + i, 2 * twice_y + j, value)
    for axis, i, j, value in ((0, 1, 1, 2 * p1), (0, 2, 0, 3 * p2), (0, 0, 2, p2)):
        add(axis, i, j, value)
    for axis, i, j, value in ((1, 2, 0, p1), (1, 0, 2, 3 * p1), (1, 1, 1, 2 * p2)):
        add(axis, i, j, value)
    return np.array(K), bend


def _lens_of(state: _State, model: "pycolmap.Reconstruction") -> Cameras:
    camera = model.cameras[next(iter(model.images.values())).camera_id]
    fx, fy, cx, cy = state.K
    K = torch.tensor([[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]], dtype=torch.float64)
    assert state.bend.size == len(DISTORTION_PARAMETERS["POLYNOMIAL"])
    distortion = torch.from_numpy(state.bend.reshape(1, -1))
    return Cameras(K, distortion, torch.eye(4, dtype=torch.float64)[None], camera.width, camera.height, "POLYNOMIAL")


def _monomials(x: Float[np.ndarray, "m 2"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x^i y^j of all exponents, and their derivatives by x and by y."""
    powers = [np.ones_like(x), x]
    for _ in range(4):
        powers.append(powers[-1] * x)
    value = np.stack([powers[i][:, 0] * powers[j][:, 1] for i, j in EXPONENTS], 1)
    by_x = np.stack([i * powers[max(i - 1, 0)][:, 0] * powers[j][:, 1] for i, j in EXPONENTS], 1)
    by_y = np.stack([j * powers[i][:, 0] * powers[max(j - 1, 0)][:, 1] for i, j in EXPONENTS], 1)
    return value, by_x, by_y


def _in_camera(state: _State, seen: _Observations) -> Float[np.ndarray, "m 3"]:
    """Points in the axes of the cameras that observe them."""
    turned = np.einsum("mij,mj->mi", state.rotation[seen.frame], state.points[seen.point])
    return turned + state.translation[seen.frame]


def _residuals(state: _State, seen: _Observations) -> Float[np.ndarray, "m 2"]:
    at = _in_camera(state, seen)
    plane = at[:, :2] / at[:, 2:]
    value, _, _ = _monomials(plane)
    return (plane + value @ state.bend.T) * state.K[:2] + state.K[2:] - seen.xy


def _errors(state: _State, seen: _Observations) -> Float[np.ndarray, " m"]:
    return np.linalg.norm(_residuals(state, seen), axis=1)


def _held_error(state: _State, seen: _Observations) -> float:
    return float(np.median(_errors(state, seen)[seen.held]))


def _cost(state: _State, seen: _Observations) -> float:
    error = _errors(state, seen)[~seen.held]
    return float((2 * _WIDTH**2 * (np.sqrt(1 + (error / _WIDTH) ** 2) - 1)).sum())


def _adjusted(state: _State, seen: _Observations, degree: int, turns: int = _TURNS) -> _State:
    """A state adjusted with its lens up to a degree, 0 to hold it."""
    damping, cost = _DAMPING, _cost(state, seen)
    for _ in range(turns):
        system = _System(state, seen, degree)
        while True:
            after = system.stepped(damping)
            lower = _cost(after, seen)
            if lower < cost:
                break
            damping *= 5
            if damping > 1e6:
                return state
        gained, state, cost, damping = 1 - lower / cost, after, lower, max(damping / 5, 1e-9)
        if gained < _CONVERGED:
            break
    return state


class _System:
    """The normal equations at a state: poses and lens dense, points eliminated."""

    def __init__(self, state: _State, seen: _Observations, degree: int) -> None:
        used = _Observations(*(part[~seen.held] for part in (seen.frame, seen.point, seen.xy, seen.held)))
        self._state, self._n, self._p = state, len(state.translation), len(state.points)
        self._terms = [k for k, (i, j) in enumerate(EXPONENTS) if i + j <= degree]
        residual = _residuals(state, used)
        root = (1 + (residual**2).sum(1) / _WIDTH**2) ** -0.25  # square root of the loss's weight
        by_pose, by_point, by_lens = (J * root[:, None, None] for J in self._jacobians(used, with_lens=degree > 0))
        residual = (residual * root[:, None]).reshape(-1)
        J = sparse.hstack(
            [
                _blocks(by_pose, used.frame, self._n),
                sparse.csr_array(by_lens.reshape(len(residual), by_lens.shape[2])),
            ],
            format="csr",
        )
        to_points = _blocks(by_point, used.point, self._p)
        self._W = (J.T @ to_points).tocsr()
        self._A = (J.T @ J).toarray()
        self._b, self._b_points = J.T @ residual, to_points.T @ residual
        self._V = np.zeros((self._p, 3, 3))
        np.add.at(self._V, used.point, np.einsum("mij,mik->mjk", by_point, by_point))

    def stepped(self, damping: float) -> _State:
        """The state after a step, its diagonals enlarged by a share `damping`."""
        diagonal = np.einsum("pii->pi", self._V)
        V = self._V + (damping * diagonal + 1e-9)[:, :, None] * np.eye(3)
        inverse = _diagonal(np.linalg.inv(V))
        WV = self._W @ inverse
        A = self._A + np.diag(damping * np.diag(self._A) + 1e-9) - (WV @ self._W.T).toarray()
        step = np.linalg.solve(A, -(self._b - WV @ self._b_points))
        points = -(inverse @ (self._b_points + self._W.T @ step)).reshape(-1, 3)
        poses, lens = step[: 6 * self._n].reshape(-1, 6), step[6 * self._n :]
        state, K, bend = self._state, self._state.K.copy(), self._state.bend.copy()
        if len(lens):
            K = K + lens[:4] * np.repeat(K[:2].mean(), 4)
            for axis, part in enumerate(lens[4:].reshape(2, -1)):
                bend[axis, self._terms] += part
        turn = Rotation.from_rotvec(poses[:, :3]).as_matrix()
        translation = np.einsum("nij,nj->ni", turn, state.translation) + poses[:, 3:]
        return replace(
            state,
            rotation=turn @ state.rotation,
            translation=translation,
            points=state.points + points,
            K=K,
            bend=bend,
        )

    def _jacobians(self, used: _Observations, *, with_lens: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of the residuals [m, 2, .] by turns and shifts of the cameras, by points, and by K in mean focal lengths
        and the coefficients.
        """
        state = self._state
        at = _in_camera(state, used)
        z = at[:, 2]
        plane = at[:, :2] / z[:, None]
        value, by_x, by_y = _monomials(plane)
        bent = np.stack([by_x @ state.bend.T, by_y @ state.bend.T], 2) + np.eye(2)  # m 2 2
        focal = state.K[:2, None]
        onto = np.zeros((len(at), 2, 3))
        onto[:, 0, 0] = onto[:, 1, 1] = 1 / z
        onto[:, :, 2] = -plane / z[:, None]
        by_place = (bent * focal) @ onto  # by the point in the camera's axes
        x, y = at[:, 0], at[:, 1]
        zero = np.zeros_like(z)
        turned = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], 1).reshape(-1, 3, 3)  # -[at]x
        by_pose = np.concatenate([by_place @ turned, by_place], 2)
        by_point = by_place @ state.rotation[used.frame]
        if not with_lens:
            return by_pose, by_point, np.zeros((len(at), 2, 0))
        terms = len(self._terms)
        by_lens = np.zeros((len(at), 2, 4 + 2 * terms))
        distorted = plane + value @ state.bend.T
        scale = state.K[:2].mean()
        for axis in range(2):
            by_lens[:, axis, axis] = distorted[:, axis] * scale
            by_lens[:, axis, 2 + axis] = scale
            first = 4 + axis * terms
            by_lens[:, axis, first : first + terms] = value[:, self._terms] * state.K[axis]
        return by_pose, by_point, by_lens


def _blocks(J: Float[np.ndarray, "m r k"], column: Int[np.ndarray, " m"], count: int) -> sparse.csr_array:
    """Jacobians of single observations as one sparse matrix with `count` groups of columns."""
    m, rows, k = J.shape
    indices = np.repeat((column[:, None] * k + np.arange(k))[:, None], rows, 1).reshape(-1)
    return sparse.csr_array((J.reshape(-1), indices, np.arange(m * rows + 1) * k), shape=(m * rows, count * k))


def _diagonal(blocks: Float[np.ndarray, "p 3 3"]) -> sparse.csr_array:
    """Blocks along a diagonal as one sparse matrix."""
    return _blocks(blocks, np.arange(len(blocks)), len(blocks))
