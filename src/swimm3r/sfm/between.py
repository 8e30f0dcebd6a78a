"""Poses of the frames between keyframes: points of the keyframes around them, tracked into them, and PnP.

The keyframes of a rig are those of the frame's own camera, and so is the lens.
The cost of a frame is that of tracking a few hundred points; it takes no part in anything else.
"""

import logging
from bisect import bisect_left
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch

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

log = logging.getLogger(__name__)

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
    known: dict[str | None, list[tuple[int, int]]] = {frame.camera: [] for frame in frames}
    for i, frame in enumerate(frames):
        if frame.name in placed:
            known[frame.camera].append((i, placed[frame.name]))
    observations = _observations(rec)

    def place(i: int) -> Cameras | None:
        own = known[frames.frames[i].camera]
        at = bisect_left(own, (i, -1))
        return _place(i, own[max(0, at - 1) : at + 1], rec, frames, observations)

    names, cameras = [], []
    with ThreadPoolExecutor(thread_count()) as pool:
        for done, (i, camera) in enumerate(zip(between, pool.map(place, between), strict=True)):
            progress(_STEP, done, len(between))
            if camera is not None:
                names.append(frames.frames[i].name)
                cameras.append(camera)
    progress(_STEP, len(between), len(between))
    (folder / BETWEEN).unlink(missing_ok=True)
    for camera in sorted(str(camera) for camera, own in known.items() if not own):
        log.warning("frames between keyframes of %s have no pose: no keyframe of that camera is registered", camera)
    if cameras:
        K, distortion, cam2world = (
            torch.cat([getattr(camera, part) for camera in cameras]) for part in ("K", "distortion", "cam2world")
        )
        joined = replace(rec.cameras, K=K, distortion=distortion, cam2world=cam2world)
        joined.save(folder / BETWEEN, tuple(names), frames.times_of(names), "metres" if rec.metric else "scene units")


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
) -> Cameras | None:
    """A frame's lens and pose by its camera's keyframes before and after it; None where too few points agree."""
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
    lens = rec.cameras[around[0][1]]
    estimate = absolute_pose(xy, xyz, lens, max_error)
    if estimate is None or int(estimate[1].sum()) < _FEWEST:
        return None
    return replace(lens, cam2world=estimate[0][None])
