"""Rows that were exposed one after another: the readout time, and poses at half of each frame's exposure.

Row y of an image of H rows is exposed (y / H - 1/2) T after half time, T the time between the first and the last row,
negative of a film that was turned upside down. A camera that moves shows a point there shifted by

    s(T) = T (y / H - 1/2) du/dt,

u its pixel and du/dt that of the point as the path of the camera goes on. The path is a polynomial through the poses of
five frames at their times, so motion that is faster than the frames follow each other is not seen. Poses, points and
lens are adjusted to observations without their shift (as behind a port, `adjustment`). The errors that then remain
along the shift say how far T is off,

    g(T) = sum w a e / sum w a^2,    a = (y / H - 1/2) du/dt,

e the reprojection errors and w the weights of the robust loss. Poses and lens take up a part of a wrong T, so g is too
small (eleven times on a swaying camera 1.5 m over the ground), but still 0 at the right one, which the secant method
finds.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from swimm3r.cameras import Cameras, project, rows_of_frames
from swimm3r.progress import Progress, silent
from swimm3r.scene.reconstruction import QualityWarning, Reconstruction
from swimm3r.sfm.colmap.adjustment import adjust_model, with_adjusted_model
from swimm3r.sfm.colmap.calibration.refinement import adjust_within_family

_LONGEST = 0.5  # intervals between frames; video cameras have 5 to 35 ms
_GAP = 3.0  # median intervals between frames beyond which the path does not go on
_STENCIL = 5  # frames that a velocity is told from; errors of splines at their ends bend the whole path
_TURNS = 8  # of the secant method at most
_AGAIN = 2  # adjustments under one T, as the path changes with the poses: 0.01 px after the first, 0.0003 px further
_EXACT = 0.02  # share of the readout time to which it is found
_CERTAIN = 5.0  # standard deviations that it must be away from 0
_STEP = "rolling shutter"

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Rolled:
    """A reconstruction whose poses are those at half of each frame's exposure."""

    reconstruction: Reconstruction
    readout: float  # s; 0 where the frames do not show it
    std: float | None  # s; None where it was given
    warning: QualityWarning | None


@dataclass(frozen=True)
class Motion:
    """Velocities of the cameras at their frames, in their own axes; 0 where the path around is not known."""

    turning: Float[np.ndarray, "n 3"]  # rad/s
    moving: Float[np.ndarray, "n 3"]  # scene units per second


def adjust_rolling(
    rec: Reconstruction,
    times: Sequence[float],
    readout: float | None,
    *,
    lens: bool,
    progress: Progress = silent,
) -> Rolled:
    """The reconstruction under rows that are exposed within `readout` seconds, which is estimated where it is None.

    `times` are those of half of each frame's exposure, s; with `lens` the lens is adjusted, too. Tracks keep the pixels
    that were observed; errors of points are those without their shift. Where the frames do not show a rolling shutter,
    the reconstruction stays as it is, with a warning.
    """
    if readout is not None:
        progress(_STEP, 0, 1)
        rec = _adjusted(rec, times, readout, lens=lens)
        progress(_STEP, 1, 1)
        return Rolled(rec, readout, None, None)
    longest = _LONGEST * _interval(np.asarray(times, np.float64))
    tried: list[tuple[float, float]] = []  # T and g(T)
    found, T, std = rec, 0.0, 0.0
    for turn in range(_TURNS):
        progress(_STEP, turn, _TURNS)
        off, std = _remaining(found, times, T)
        tried.append((T, off))
        if not np.isfinite(std):  # nothing moves
            break
        if turn and abs(off) * _taken_up(tried) < _EXACT * abs(T):
            break
        T = float(np.clip(_next(tried), -longest, longest))
        found = _adjusted(rec, times, T, lens=lens)
    progress(_STEP, _TURNS, _TURNS)
    std *= _taken_up(tried)
    log.info("readout time of the rolling shutter: %.2f +- %.2f ms", 1e3 * T, 1e3 * std)
    if _CERTAIN * std < abs(T) < longest:
        return Rolled(found, T, std, None)
    return Rolled(rec, 0.0, std, not_shown(T, std))


def motion_of(cameras: Cameras, times: Sequence[float]) -> Motion:
    """Velocities of cameras at their times, by the derivatives of polynomials through the poses of frames without a gap
    between them: of rotation vectors and places in the axes of the frame in question.
    """
    order = np.argsort(times)
    at = np.asarray(times, np.float64)[order]
    poses = cameras.cam2world.numpy()[order]
    turning, moving = np.zeros((len(at), 3)), np.zeros((len(at), 3))
    for run in _runs(at):
        for k, i in enumerate(run):
            first = max(0, min(k - _STENCIL // 2, len(run) - _STENCIL))
            near = run[first : first + _STENCIL]
            own = np.linalg.inv(poses[i]) @ poses[near]
            weights = _derivative(at[near] - at[i])
            turning[i] = weights @ Rotation.from_matrix(own[:, :3, :3]).as_rotvec()
            moving[i] = weights @ own[:, :3, 3]
    back = np.argsort(order)
    return Motion(turning[back], moving[back])


def not_shown(T: float, std: float) -> QualityWarning:
    """The warning about frames that do not say how fast their rows were read."""
    found = f"a readout of {1e3 * T:.1f} ms, give or take {1e3 * std:.1f}" if np.isfinite(std) else "no time passes"
    return QualityWarning(
        f"The frames do not show a rolling shutter ({found}): all rows are taken as exposed at once.",
        "Give --readout in seconds, if it is known; or a higher --fps, so that the path between frames is smooth.",
    )


def _derivative(times: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
    """Weights with which values at some times give the derivative at 0 of the polynomial through them."""
    if len(times) < 2:
        return np.zeros(len(times))
    unit = np.abs(times).max()
    wanted = np.zeros(len(times))
    wanted[1] = 1 / unit
    return np.linalg.solve(np.vander(times / unit, increasing=True).T, wanted)


def _runs(times: Float[np.ndarray, " n"]) -> list[np.ndarray]:
    """Positions of frames in time order, parted at gaps and where several have one time."""
    steps = np.diff(times)
    return np.split(np.arange(len(times)), 1 + np.flatnonzero((steps <= 0) | (steps > _GAP * _interval(times))))


def _interval(times: Float[np.ndarray, " n"]) -> float:
    """Median time between frames, s; 0 where all have one time."""
    steps = np.diff(np.sort(times))
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0


def _next(tried: list[tuple[float, float]]) -> float:
    """The T where a line through the last two g is 0; after the first, where g says."""
    if len(tried) == 1:
        return tried[0][1]
    (T0, g0), (T1, g1) = tried[-2:]
    return T1 + g1 * (T1 - T0) / (g0 - g1) if g0 != g1 else T1


def _taken_up(tried: list[tuple[float, float]]) -> float:
    """Factor from an error of g to one of T: poses and lens take up the rest."""
    if len(tried) < 2:
        return 1.0
    (T0, g0), (T1, g1) = tried[0], tried[-1]
    return abs((T1 - T0) / (g0 - g1)) if g0 != g1 else 1.0


def _remaining(rec: Reconstruction, times: Sequence[float], T: float) -> tuple[float, float]:
    """g(T) of a reconstruction adjusted under T, and its standard deviation if frames are independent."""
    along = _shift_per_second(rec, times)
    left = rec.tracks.xy.double() - T * along - _pixels(rec)
    seen = torch.isfinite(left).all(-1) & torch.isfinite(along).all(-1)
    error = torch.where(seen[:, None], left, 0.0)
    along = torch.where(seen[:, None], along, 0.0)
    width = _typical_error(rec)
    weight = (1 + (error / width).square().sum(-1)).rsqrt()  # of SOFT_L1
    of_frame = torch.zeros(len(rec.names), 2, dtype=torch.float64)
    terms = torch.stack([weight * (along * error).sum(-1), weight * along.square().sum(-1)], 1)
    of_frame.index_add_(0, rec.tracks.frame, terms)
    total = of_frame.sum(0)
    if total[1] == 0:
        return 0.0, float("inf")
    g = total[0] / total[1]
    spread = (of_frame[:, 0] - g * of_frame[:, 1]).square().sum().sqrt() / total[1]
    return g.item(), spread.item()


def _typical_error(rec: Reconstruction) -> float:
    """Median error of the points, px: the width of the robust loss."""
    errors = rec.points.error[torch.bincount(rec.tracks.point, minlength=len(rec.points.error)) > 1]
    return float(errors.double().median().clamp(0.01, 1.0)) if len(errors) else 1.0


def _adjusted(rec: Reconstruction, times: Sequence[float], T: float, *, lens: bool) -> Reconstruction:
    with_lens = partial(adjust_within_family, free=partial(adjust_model, lens=True), held=adjust_model)
    adjust = with_lens if lens else adjust_model
    for _ in range(_AGAIN):
        shift = torch.nan_to_num(T * _shift_per_second(rec, times), nan=0.0)
        tracks = replace(rec.tracks, xy=(rec.tracks.xy.double() - shift).to(rec.tracks.xy))
        moved = with_adjusted_model(replace(rec, tracks=tracks), adjust)
        points = replace(rec.points, xyz=moved.points.xyz, error=moved.points.error)
        rec = replace(rec, cameras=moved.cameras, points=points)
    return rec


def _shift_per_second(rec: Reconstruction, times: Sequence[float]) -> Float[torch.Tensor, "t 2"]:
    """a of every observation, px per second of readout; NaN behind the camera."""
    motion, cameras = motion_of(rec.cameras, times), rec.cameras
    out = torch.full((len(rec.tracks.point), 2), torch.nan, dtype=torch.float64)
    for i, rows in enumerate(rows_of_frames(rec.tracks.frame, len(rec.names))):
        points = rec.points.xyz[rec.tracks.point[rows]].double()[None]
        later = (_moved(cameras[i], motion.turning[i], motion.moving[i], dt) for dt in (-_MOMENT, _MOMENT))
        ends = [project(camera, points) for camera in later]
        speed = (ends[1][0][0] - ends[0][0][0]) / (2 * _MOMENT)
        speed[(ends[0][1][0] <= 0) | (ends[1][1][0] <= 0)] = torch.nan
        out[rows] = (rec.tracks.xy[rows, 1:].double() / cameras.height - 0.5) * speed
    return out


_MOMENT = 1e-3  # s over which the path is straight


def _moved(camera: Cameras, turning: np.ndarray, moving: np.ndarray, dt: float) -> Cameras:
    """One camera as it is `dt` seconds later."""
    step = torch.eye(4, dtype=torch.float64)
    step[:3, :3] = torch.from_numpy(Rotation.from_rotvec(turning * dt).as_matrix())
    step[:3, 3] = torch.from_numpy(moving * dt)
    return replace(camera, cam2world=camera.cam2world.double() @ step)


def _pixels(rec: Reconstruction) -> Float[torch.Tensor, "t 2"]:
    """The pixels of the observed points as their cameras have them at half time."""
    out = torch.empty(len(rec.tracks.point), 2, dtype=torch.float64)
    for i, rows in enumerate(rows_of_frames(rec.tracks.frame, len(rec.names))):
        out[rows] = project(rec.cameras[i], rec.points.xyz[rec.tracks.point[rows]].double()[None])[0][0]
    return out
