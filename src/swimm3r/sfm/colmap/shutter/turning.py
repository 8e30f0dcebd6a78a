"""Turns of the camera within the exposure of each frame, from the tracks alone.

`readout` knows a camera's motion from the path between frames. Where frames are a second apart, or stills, each has a
motion of its own: the rotation vector w within the exposure of a frame (`imaging.turned_rows`). Poses, points and turns
are adjusted together (`extended_adjustment`) to the errors

    pi(R_f X_p + t_f) - pi(exp((y / H - 1/2) w_f) d_o)

with d_o the ray of observation o in row y and pi the division by depth, in pixels. Turns are expected to
be small, as tracks hardly determine some: a turn that all frames share looks like another lens. A fifth of the
observations is held out and judges: turns are believed where they bring these clearly closer.
"""

import logging
import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.spatial.transform import Rotation
from torch import Tensor

from swimm3r.cameras import Cameras, directions, rows_of_frames
from swimm3r.imaging.turned_rows import RowTurns
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.colmap.extended_adjustment import Bundle, adjusted, blocks, cross, division_jacobian, places

EXPECTED_TURN = 0.002
"""Standard deviation of turns within a frame, radians: 20 ms at 6 degrees per second."""
_CLEARLY = 0.95  # of the median held-out error, below which turns are believed
_NOTABLE = 0.01  # px by which it must fall, too: precise keypoints tell turns that no picture shows
_HELD_OUT = 0.2  # of the observations of points that enough others show
_ENOUGH = 3  # observations of a point that are left
_FEWEST = 500  # held-out observations that can judge
_FEWEST_FRAMES = 6
_STRETCH, _MOST = 200, 40_000  # frames that are adjusted at once, and their observations that are looked at
_STEPS = 12  # of the adjustment
_WIDTHS = (0.05, 1.0)  # px, least and largest width of the loss

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Observed:
    """Rays of observations on the plane z = 1, with the points, frames and rows they are of."""

    point: Int[np.ndarray, " o"]
    frame: Int[np.ndarray, " o"]
    ray: Float[np.ndarray, "o 3"]
    row: Float[np.ndarray, " o"]  # y / H - 1/2
    focal: float  # px
    width: float  # px
    prior_std: float = EXPECTED_TURN

    def some(self, chosen: Bool[np.ndarray, " o"]) -> "_Observed":
        point, frame, ray, row = (part[chosen] for part in (self.point, self.frame, self.ray, self.row))
        return replace(self, point=point, frame=frame, ray=ray, row=row)

    def errors(self, bundle: Bundle) -> Float[np.ndarray, "o 2"]:
        place, ray = places(bundle, self), self._at_half_time(bundle)
        return self.focal * (place[:, :2] / place[:, 2:] - ray[:, :2] / ray[:, 2:])

    def by_place(self, bundle: Bundle) -> Float[np.ndarray, "o 2 3"]:
        return self.focal * division_jacobian(places(bundle, self))

    def by_others(self, bundle: Bundle) -> sparse.csr_array:
        if not len(bundle.others):
            return sparse.csr_array((2 * len(self.point), 0))
        ray, turned = self._at_half_time(bundle), cross(self.row[:, None] * bundle.others.reshape(-1, 3)[self.frame])
        along = np.eye(3) + turned / 2 + turned @ turned / 6  # left Jacobian of small rotations
        by_turn = self.row[:, None, None] * (self.focal * division_jacobian(ray) @ cross(ray) @ along)
        return blocks(by_turn, self.frame, len(bundle.R))

    def _at_half_time(self, bundle: Bundle) -> Float[np.ndarray, "o 3"]:
        """Rays as exposed at half time: the other unknowns are the turns of the frames, or none."""
        if not len(bundle.others):
            return self.ray
        return Rotation.from_rotvec(self.row[:, None] * bundle.others.reshape(-1, 3)[self.frame]).apply(self.ray)


def turned_rows(rec: Reconstruction) -> RowTurns | None:
    """The turns of a reconstruction's frames; None where held-out observations do not show that its camera turned.

    All frames are of one lens, whose poses and points are as adjusted without turns. Of long clips stretches of frames
    are adjusted one by one. A fisheye's rays have no places on a plane, and are not asked.
    """
    n = len(rec.names)
    if n < _FEWEST_FRAMES or rec.cameras.model == "OPENCV_FISHEYE":
        return None
    observed, start = _observed(rec), _start(rec)
    stretches = np.array_split(np.arange(n), math.ceil(n / _STRETCH))
    parts = [_stretch(observed, start, int(frames[0]), int(frames[-1]) + 1) for frames in stretches]
    errors: tuple[list[np.ndarray], list[np.ndarray]] = [], []
    turning = []
    for part, bundle in parts:
        held_out = _held_out(part.point)
        fitted, judge = part.some(~held_out), part.some(held_out)
        found = [adjusted(begun, fitted, _STEPS) for begun in (bundle, _with_turns(bundle))]
        for one, off in zip(found, errors, strict=True):
            off.append(np.linalg.norm(judge.errors(one), axis=-1))
        turning.append(found[1])
    without, with_turns = (np.concatenate(off) for off in errors)
    if len(without) < _FEWEST:
        return None
    before, after = float(np.median(without)), float(np.median(with_turns))
    log.info("rows exposed while the camera turned: held-out observations %.3f px off, %.3f without", after, before)
    if not after <= min(_CLEARLY * before, before - _NOTABLE):  # also where one of them is no number
        return None
    every = [adjusted(bundle, part, _STEPS).others for (part, _), bundle in zip(parts, turning, strict=True)]
    lens = replace(rec.cameras[0], cam2world=torch.eye(4, dtype=torch.float64)[None])
    return RowTurns(lens, dict(zip(rec.names, np.concatenate(every).reshape(-1, 3), strict=True)))


def turned_pose(
    camera: Cameras, xy: Float[Tensor, "k 2"], xyz: Float[Tensor, "k 3"]
) -> tuple[Float[Tensor, "4 4"], Float[np.ndarray, "3"]]:
    """Pose and turn of one camera near where it is that show points of the world in pixels as filmed."""
    rays = directions(camera, xy.double()[None])[0].numpy()
    frame, point = np.zeros(len(rays), dtype=np.int64), np.arange(len(rays))
    row = (xy[:, 1].double() / camera.height - 0.5).numpy()
    world2cam = camera.world2cam[0].double().numpy()
    found = Bundle(world2cam[None, :3, :3], world2cam[None, :3, 3], xyz.double().numpy(), np.zeros(3))
    observed = _Observed(point, frame, rays, row, camera.K[0, 0, 0].item(), _WIDTHS[1])
    for _ in range(2):  # the second time with the width of the errors that are left
        found = adjusted(found, observed, _STEPS, points_stay=True)
        error = np.linalg.norm(observed.errors(found), axis=-1)
        observed = replace(observed, width=float(np.clip(np.median(error), *_WIDTHS)))
    cam2world = torch.eye(4, dtype=torch.float64)
    cam2world[:3, :3] = torch.from_numpy(found.R[0].T)
    cam2world[:3, 3] = torch.from_numpy(-found.R[0].T @ found.t[0])
    return cam2world, found.others


def _start(rec: Reconstruction) -> Bundle:
    cam2world = rec.cameras.cam2world.double().numpy()
    R = np.swapaxes(cam2world[:, :3, :3], 1, 2).copy()
    t = -np.einsum("nij,nj->ni", R, cam2world[:, :3, 3])
    return Bundle(R, t, rec.points.xyz.double().numpy(), np.zeros(0))


def _with_turns(bundle: Bundle) -> Bundle:
    return replace(bundle, others=np.zeros(3 * len(bundle.R)))


def _observed(rec: Reconstruction) -> _Observed:
    tracks = rec.tracks
    rays = torch.full((len(tracks.point), 3), torch.nan, dtype=torch.float64)
    for i, rows in enumerate(rows_of_frames(tracks.frame, len(rec.names))):
        rays[rows] = directions(rec.cameras[i], tracks.xy[rows].double()[None])[0]
    row = tracks.xy[:, 1].double() / rec.cameras.height - 0.5
    width = float(np.clip(np.nanmedian(rec.points.error.double().numpy()), *_WIDTHS))  # the median error of the points
    focal = rec.cameras.K[0, 0, 0].item()
    found = _Observed(tracks.point.numpy(), tracks.frame.numpy(), rays.numpy(), row.numpy(), focal, width)
    return found.some(np.asarray(np.isfinite(found.ray).all(-1)))


def _stretch(observed: _Observed, bundle: Bundle, first: int, end: int) -> tuple[_Observed, Bundle]:
    """Frames `first` to `end` - 1 alone, with the points that three of them show, or as many as make few enough.

    Points of two frames follow turns that there are not.
    """
    mine = observed.some((observed.frame >= first) & (observed.frame < end))
    count = np.bincount(mine.point, minlength=len(bundle.xyz))
    order = np.random.default_rng(0).permutation(len(count))
    order = order[count[order] > 2]
    chosen = np.zeros(len(count), dtype=bool)
    chosen[order[: np.searchsorted(count[order].cumsum(), _MOST)]] = True
    mine = mine.some(chosen[mine.point])
    new = chosen.cumsum() - 1
    own = replace(bundle, R=bundle.R[first:end], t=bundle.t[first:end], xyz=bundle.xyz[chosen])
    return replace(mine, point=new[mine.point], frame=mine.frame - first), own


def _held_out(point: Int[np.ndarray, " o"]) -> Bool[np.ndarray, " o"]:
    chosen = np.random.default_rng(0).random(len(point)) < _HELD_OUT
    left = np.bincount(point[~chosen], minlength=point.max(initial=0) + 1)
    return chosen & (left[point] >= _ENOUGH)
