"""Poses of the frames between keyframes: points of the keyframes around them, tracked into them, and PnP.

The cost of a frame is that of tracking a few hundred points; it takes no part in anything else.
"""

from bisect import bisect_left
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from swimm3r.cameras import Cameras
from swimm3r.imaging.gray import gray_levels, weights_for_features
from swimm3r.io.cameras_json import CameraTable, read_own_cameras
from swimm3r.io.colmap.model import silence_log
from swimm3r.io.files.damage import remake
from swimm3r.prepare.keyframes import tracked
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.colmap.absolute_pose import absolute_pose
from swimm3r.tasks.threads import thread_count

BETWEEN = "cameras_between.json"
_POINTS = 400  # of a keyframe that are tracked
_FEWEST = 12  # points that must agree on a pose
_MAX_ERROR = 4.0  # pixels of an image of 1000, as in mapping; never less than _LEAST_ERROR
_LEAST_ERROR = 2.0
_STEP = "placing frames between keyframes"


def place_between(rec: Reconstruction, frames: Frames, folder: Path, progress: Progress = silent) -> None:
    """Write the poses of the frames between keyframes to `folder`/cameras_between.json, those that can be placed."""
    silence_log()
    between = [i for i, frame in enumerate(frames) if frame.split == "between"]
    if not between:
        return
    placed = {name: row for row, name in enumerate(rec.names)}
    known = [(i, placed[frame.name]) for i, frame in enumerate(frames) if frame.name in placed]
    observations = _observations(rec)

    def place(i: int) -> Float[Tensor, "4 4"] | None:
        at = bisect_left(known, (i, -1))
        around = known[max(0, at - 1) : at + 1]
        return _place(i, around, rec, frames, observations)

    names, poses = [], []
    with ThreadPoolExecutor(thread_count()) as pool:
        for done, (i, pose) in enumerate(zip(between, pool.map(place, between), strict=True)):
            progress(_STEP, done, len(between))
            if pose is not None:
                names.append(frames.frames[i].name)
                poses.append(pose)
    progress(_STEP, len(between), len(between))
    (folder / BETWEEN).unlink(missing_ok=True)
    if poses:
        lens = rec.cameras[[0] * len(poses)]
        cameras = Cameras(lens.K, lens.distortion, torch.stack(poses), lens.width, lens.height, lens.model)
        cameras.save(folder / BETWEEN, tuple(names), frames.times_of(names), "metres" if rec.metric else "scene units")


def read_between(folder: Path) -> CameraTable | None:
    """The poses that `place_between` wrote, None where there are none. Raises InputError where they are damaged."""
    path = folder / BETWEEN
    return read_own_cameras(path, remake(folder)) if path.is_file() else None


def _observations(rec: Reconstruction) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pixels and points of each registered frame, evenly thinned."""
    order = torch.argsort(rec.tracks.frame, stable=True)
    bounds = torch.searchsorted(rec.tracks.frame[order], torch.arange(len(rec.names) + 1)).tolist()
    out = []
    for first, last in pairwise(bounds):
        rows = order[first:last]
        rows = rows[torch.linspace(0, len(rows) - 1, min(len(rows), _POINTS)).round().long()] if len(rows) else rows
        out.append((rec.tracks.xy[rows].float().numpy(), rec.points.xyz[rec.tracks.point[rows]].double().numpy()))
    return out


def _place(
    i: int,
    around: Sequence[tuple[int, int]],
    rec: Reconstruction,
    frames: Frames,
    observations: list[tuple[np.ndarray, np.ndarray]],
) -> Float[Tensor, "4 4"] | None:
    """cam2world of a frame from the registered ones before and after it; None where too few points agree."""
    weights = weights_for_features(frames.image(i), frames.mask(i))
    image = gray_levels(frames.image(i), weights)
    pixels, points = [], []
    for k, row in around:
        xy, xyz = observations[row]
        if len(xy):
            there, found = tracked(gray_levels(frames.image(k), weights), image, xy)
            pixels.append(there[found])
            points.append(xyz[found])
    if sum(map(len, pixels)) < _FEWEST:
        return None
    max_error = max(_LEAST_ERROR, _MAX_ERROR * max(frames.width, frames.height) / 1000)
    xy, xyz = (torch.from_numpy(np.concatenate(part).astype(np.float64)) for part in (pixels, points))
    estimate = absolute_pose(xy, xyz, rec.cameras[around[0][1]], max_error)
    if estimate is None or int(estimate[1].sum()) < _FEWEST:
        return None
    return estimate[0]
