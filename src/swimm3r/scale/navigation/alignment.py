"""The similarity from a run to local metres by the path of its cameras, with covariance.

    p_i + A_i l = s R c_i + t + noise          positions of the vehicle; l lever arm, A_i attitude
    A_i M = R R_i exp(noise)                   attitude, where given; M mounting of the camera, the same in all frames
    R up_scene = z + noise                     gravity, else the ground below the cameras: holds what a straight path
                                               leaves open

Solved by weighted least squares over log s, R, t and M; rows far off count less (Cauchy), and the standard deviation of
positions is that of the residuals where none is given. Errors of navigation last for many rows: the covariance grows by
the correlation of neighboring residuals.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import OptimizeResult, least_squares
from scipy.spatial.transform import Rotation

from swimm3r.scale.settings import ScaleSettings

MOUNTS = {  # camera axes (right, down, ahead of the image) in those of the vehicle (forward, starboard, down)
    "down": np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
    "forward": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
}
_HALF_TURN = np.pi  # standard deviation of a heading that is not known
GROUND_STD = np.radians(20.0)  # of up by the normal of the ground, which slopes
_REFINED = 2  # of the beginnings, the best ones
_ROUNDS = 12
_SETTLED = 1e-6  # of the sizes of the unknowns, between rounds
_EVALUATIONS = 12  # in a round; a good beginning takes 4
_TUNING = 2.385  # of Cauchy's weights: 95% efficiency under Gaussian noise
_LEAST_STD = 1e-4  # metres


@dataclass(frozen=True)
class Path:
    """Cameras of a run, and what navigation says of them; rows correspond."""

    centers: Float[np.ndarray, "k 3"]  # in the run
    rotations: Float[np.ndarray, "k 3 3"]  # camera to run
    position: Float[np.ndarray, "k 3"]  # local metres
    std: Float[np.ndarray, "k 3"] | None  # metres; None: unknown; infinite where a coordinate is not known
    attitude: Float[np.ndarray, "k 3 3"] | None
    attitude_std: Float[np.ndarray, "k 3"]  # about the vehicle's forward, starboard and down axes, radians
    up: Float[np.ndarray, "3"]  # of the scene, in the run
    up_std: float  # radians

    def rows(self, marked: Bool[np.ndarray, " k"]) -> "Path":
        """The marked rows alone."""
        return replace(
            self,
            centers=self.centers[marked],
            rotations=self.rotations[marked],
            position=self.position[marked],
            std=None if self.std is None else self.std[marked],
            attitude=None if self.attitude is None else self.attitude[marked],
            attitude_std=self.attitude_std[marked],
        )


@dataclass(frozen=True)
class Alignment:
    """A similarity x -> s R x + t from a run to local metres."""

    scale: float
    R: Float[np.ndarray, "3 3"]
    t: Float[np.ndarray, "3"]
    scale_std: float  # relative
    rotation_std_deg: Float[np.ndarray, "3"]  # about local east, north and up
    center_std: Float[np.ndarray, "3"]  # of the middle of the path, metres
    residual: Float[np.ndarray, "k 3"]  # metres, aligned less stated
    std: Float[np.ndarray, "k 3"]  # metres, as used
    weight: Float[np.ndarray, " k"]  # 0..1
    correlation: float  # factor by which neighbors that err alike lower the number of independent rows
    attitude_residual_deg: float | None  # root mean square
    mount: Float[np.ndarray, "3 3"] | None

    @property
    def rms(self) -> float:
        """Root mean square distance from the stated positions, metres, over the coordinates that are known."""
        known = np.where(np.isfinite(self.std), self.residual, 0.0)
        return float(np.sqrt((known**2).sum(1).mean()))

    @property
    def outliers(self) -> Bool[np.ndarray, " k"]:
        """Rows further off than 4 standard deviations."""
        return (np.abs(self.residual) / self.std).max(1) > 4.0


def align(path: Path, settings: ScaleSettings) -> Alignment:
    """The best similarity, from several beginnings."""
    starts = _starts(path, settings)
    starts = sorted(starts, key=lambda start: _first_cost(path, settings, start))[:_REFINED]
    found = [_refine(path, settings, start) for start in starts]
    return min(found, key=lambda each: each[0])[1]


def realign(path: Path, settings: ScaleSettings, start: Alignment) -> Alignment:
    """The similarity of a path near that of another one, by its standard deviations and weights of positions."""
    middle = path.centers.mean(0)
    problem = _Problem(path, settings, middle, start.R, start.mount)
    x = np.concatenate([[np.log(start.scale)], np.zeros(3), start.scale * start.R @ middle + start.t, np.zeros(3)])
    return _result(problem, problem.solved(x[: problem.count], start.std, start.weight), start.std, start.weight)


def umeyama(
    source: Float[np.ndarray, "k 3"], target: Float[np.ndarray, "k 3"], weight: Float[np.ndarray, " k"] | None = None
) -> tuple[float, Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Scale, rotation and translation with the least weighted squared error (Umeyama 1991)."""
    w = np.ones(len(source)) if weight is None else weight
    w = w / w.sum()
    a, b = source - w @ source, target - w @ target
    U, values, Vt = np.linalg.svd((b * w[:, None]).T @ a)
    hand = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt)) or 1.0])
    R = (U * hand) @ Vt
    scale = float((values * hand).sum() / (w @ (a**2).sum(1)))
    return scale, R, w @ target - scale * R @ (w @ source)


def _starts(path: Path, settings: ScaleSettings) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Beginnings: the centers alone, and turned half about the path, and the attitude where the mounting is known."""
    target = _camera_positions(path, settings)
    known = np.ones(3) if path.std is None else np.array([not np.isinf(column).all() for column in path.std.T])
    target = target * known
    scale, R, t = umeyama(path.centers, target)
    along = np.linalg.svd(target - target.mean(0), full_matrices=False)[2][0]
    starts = [(scale, R, t)]
    for turn in (0.5, 1.0, 1.5):
        turned = Rotation.from_rotvec(turn * np.pi * along).as_matrix() @ R
        starts.append((scale, turned, target.mean(0) - scale * turned @ path.centers.mean(0)))
    if path.attitude is not None and settings.camera_mount != "free":
        whole = np.isfinite(path.attitude).all((1, 2))
        sum_of = np.einsum("kij,jl,kml->im", path.attitude[whole], MOUNTS[settings.camera_mount], path.rotations[whole])
        U, _, Vt = np.linalg.svd(sum_of)
        R = (U * [1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        a, b = path.centers - path.centers.mean(0), target - target.mean(0)
        scale = float((b * (a @ R.T) * known).sum() / ((a @ R.T * known) ** 2).sum())
        if scale > 0:
            starts.append((scale, R, target.mean(0) - scale * R @ path.centers.mean(0)))
    if not known[:2].any():
        starts.append(_by_heights(path, target[:, 2]))
    return [start for start in starts if start[0] > 0]


def _by_heights(path: Path, height: Float[np.ndarray, " k"]) -> tuple[float, np.ndarray, np.ndarray]:
    """The beginning of heights alone: up as the scene shows it, the scale of heights above and below."""
    turn = Rotation.align_vectors([[0.0, 0.0, 1.0]], [path.up])[0].as_matrix()
    rise, stated = (path.centers - path.centers.mean(0)) @ path.up, height - height.mean()
    scale = float(rise @ stated / max(float(rise @ rise), 1e-18))
    return scale, turn, np.array([0.0, 0.0, height.mean()]) - scale * turn @ path.centers.mean(0)


def _camera_positions(path: Path, settings: ScaleSettings) -> Float[np.ndarray, "k 3"]:
    """Stated positions of the camera, where attitude tells the way of the lever arm; else those of the vehicle."""
    lever = np.array(settings.lever_arm)
    if path.attitude is None or not lever.any():
        return path.position
    return path.position + np.nan_to_num(path.attitude) @ lever


def _first_cost(path: Path, settings: ScaleSettings, start: tuple[float, np.ndarray, np.ndarray]) -> float:
    """The misfit of a beginning as it is."""
    scale, R, t = start
    middle = path.centers.mean(0)
    problem = _Problem(path, settings, middle, R, _mount_of(path, settings, R))
    x = np.concatenate([[np.log(scale)], np.zeros(3), scale * R @ middle + t, np.zeros(3)])[: problem.count]
    return _cost(problem, x, _first_std(path, problem.positions(x)))


def _cost(problem: "_Problem", x: np.ndarray, std: np.ndarray) -> float:
    """The misfit of a similarity whose positions have these standard deviations, comparable between beginnings."""
    cost = float(np.log1p((problem.positions(x) / std) ** 2).sum() + np.log(std[np.isfinite(std)]).sum() * 2)
    return cost + float((problem.orientation(x) ** 2).clip(max=100).sum())


def _refine(
    path: Path, settings: ScaleSettings, start: tuple[float, np.ndarray, np.ndarray]
) -> tuple[float, Alignment]:
    """Robust least squares from a beginning; its cost and result."""
    middle = path.centers.mean(0)
    scale, R, t = start
    problem = _Problem(path, settings, middle, R, _mount_of(path, settings, R))
    x = np.concatenate([[np.log(scale)], np.zeros(3), scale * R @ middle + t, np.zeros(3)])[: problem.count]
    std = _first_std(path, problem.positions(x))
    weight = np.ones(len(path.centers))
    for _ in range(_ROUNDS):
        before, x = x, problem.solved(x, std, weight).x
        residual = problem.positions(x)
        std = _first_std(path, residual)
        away = np.sqrt(((residual / std) ** 2).sum(1) / 3)
        weight = 1 / (1 + (away / _TUNING) ** 2)
        if np.abs((x - before) / problem.sizes).max() < _SETTLED:
            break
    fitted = problem.solved(x, std, weight)
    return _cost(problem, fitted.x, std), _result(problem, fitted, std, weight)


def _first_std(path: Path, residual: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
    """Standard deviations as given, else the robust spread of the residuals, horizontal and vertical."""
    given = np.full_like(residual, np.nan) if path.std is None else path.std
    level = 1.4826 * np.median(np.abs(residual[:, :2]))
    upright = 1.4826 * np.median(np.abs(residual[:, 2]))
    found = np.array([level, level, upright]).clip(_LEAST_STD)
    return np.where(np.isnan(given), found, given)


def _mount_of(path: Path, settings: ScaleSettings, R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"] | None:
    """The mounting to begin with: as stated, else the mean that the attitude shows; None without attitude."""
    if path.attitude is None or not np.isfinite(path.attitude).all((1, 2)).any():
        return None
    if settings.camera_mount != "free":
        return MOUNTS[settings.camera_mount]
    whole = np.isfinite(path.attitude).all((1, 2))
    shown = np.einsum("kji,jl,klm->kim", path.attitude[whole], R, path.rotations[whole])
    return Rotation.from_matrix(shown).mean().as_matrix()


class _Problem:
    """Residuals over (log s, turn of R, place of the middle of the path, turn of the mounting)."""

    def __init__(
        self, path: Path, settings: ScaleSettings, middle: np.ndarray, R: np.ndarray, mount: np.ndarray | None
    ) -> None:
        self.path, self.settings, self.middle, self.R0, self.mount0 = path, settings, middle, R, mount
        self.count = 7 if mount is None else 10
        self.target = _camera_positions(path, settings)
        size = max(float(np.linalg.norm(self.target - self.target.mean(0), axis=1).mean()), 1e-3)
        self.sizes = np.array([0.1, 0.1, 0.1, 0.1, size, size, size, 0.1, 0.1, 0.1])[: self.count]
        self.whole = None if mount is None else np.isfinite(path.attitude).all((1, 2))  # type: ignore[union-attr]

    def similarity(self, x: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        scale, R = float(np.exp(x[0])), Rotation.from_rotvec(x[1:4]).as_matrix() @ self.R0
        return scale, R, x[4:7] - scale * R @ self.middle

    def mount(self, x: np.ndarray) -> np.ndarray | None:
        return None if self.mount0 is None else self.mount0 @ Rotation.from_rotvec(x[7:10]).as_matrix()

    def positions(self, x: np.ndarray) -> np.ndarray:
        """Aligned camera centers less stated ones, metres."""
        scale, R, t = self.similarity(x)
        aligned = scale * self.path.centers @ R.T + t
        if self.path.attitude is None and any(self.settings.lever_arm) and self.settings.camera_mount != "free":
            vehicle = R @ self.path.rotations @ MOUNTS[self.settings.camera_mount].T
            aligned = aligned - vehicle @ np.array(self.settings.lever_arm)
        return aligned - self.target

    def attitudes(self, x: np.ndarray) -> np.ndarray:
        """Turns between stated attitudes and those of the cameras, radians, vehicle axes."""
        mount = self.mount(x)
        if mount is None or self.whole is None or self.path.attitude is None:
            return np.zeros((0, 3))
        _, R, _ = self.similarity(x)
        shown = R @ self.path.rotations[self.whole] @ mount.T
        return Rotation.from_matrix(self.path.attitude[self.whole].transpose(0, 2, 1) @ shown).as_rotvec()

    def orientation(self, x: np.ndarray) -> np.ndarray:
        """Residuals that hold the rotation beside the positions, in standard deviations."""
        _, R, _ = self.similarity(x)
        up = R @ self.path.up
        tilt = np.arctan2(np.linalg.norm(up[:2]), up[2]) * up[:2] / max(float(np.linalg.norm(up[:2])), 1e-12)
        parts = [tilt / self.path.up_std]
        if self.whole is not None:
            parts.append((self.attitudes(x) / self.path.attitude_std[self.whole]).ravel())
            if self.settings.camera_mount != "free":
                parts.append(x[7:10] / np.radians(self.settings.mount_std))
        return np.concatenate(parts)

    def solved(self, x: np.ndarray, std: np.ndarray, weight: np.ndarray) -> OptimizeResult:
        """The least squares under these weights."""
        return least_squares(
            self.residuals, x, args=(std, weight), method="trf", x_scale=self.sizes, max_nfev=_EVALUATIONS
        )

    def residuals(self, x: np.ndarray, std: np.ndarray, weight: np.ndarray) -> np.ndarray:
        rows = self.positions(x) / std * np.sqrt(weight)[:, None]
        return np.concatenate([rows.ravel(), self.orientation(x)])


def _result(problem: _Problem, fitted: OptimizeResult, std: np.ndarray, weight: np.ndarray) -> Alignment:
    scale, R, t = problem.similarity(fitted.x)
    residual = problem.positions(fitted.x)
    rows = np.sqrt(weight)[:, None] * residual / std
    used = int(np.isfinite(std).sum())
    correlation = _correlation(residual / std)
    spread = float((rows**2).sum()) / max(1, used - 7) * correlation
    free = fitted.jac.T @ fitted.jac
    covariance = np.linalg.pinv(free, rcond=1e-12) * max(1.0, spread)
    errors = np.sqrt(np.diag(covariance).clip(0))
    undetermined = ~(np.diag(free) > 0)  # heights alone say nothing of heading, east and north
    errors[undetermined] = np.where(np.arange(len(errors)) < 4, _HALF_TURN, np.inf)[undetermined]
    attitudes = problem.attitudes(fitted.x)
    shown = float(np.degrees(np.sqrt((attitudes**2).sum(1).mean()))) if len(attitudes) else None
    return Alignment(
        scale, R, t, float(errors[0]), np.degrees(errors[1:4]), errors[4:7], residual, std, weight, correlation, shown,
        problem.mount(fitted.x),
    )  # fmt: skip


def _correlation(rows: Float[np.ndarray, "k 3"]) -> float:
    """The factor by which neighbors that err alike lower the number of independent rows."""
    if len(rows) < 8:
        return 1.0
    rows = rows - rows.mean(0)
    energy = (rows**2).sum()
    correlation = float((rows[1:] * rows[:-1]).sum() / energy) if energy > 0 else 0.0
    correlation = min(max(correlation, 0.0), 0.95)
    return (1 + correlation) / (1 - correlation)


def without_attitude(path: Path) -> Path:
    """The same path by its positions alone."""
    return replace(path, attitude=None)
