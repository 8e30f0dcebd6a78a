"""Frames of either visit localized in the other's model: PnP with RANSAC, frame by frame.

A frame's keypoints are matched with points of the other visit. Those that agree on one pose are verified, and the pose
alone gives the similarity between the visits, with the ratio of depths as its scale:

    R = R' R_f^T,   s = median z_a / z_b,   t = c' - s R c_f

R', c' is the frame's pose in the other visit and R_f, c_f that in its own. Wrong matches agree on a pose by chance in
groups smaller than `MIN_INLIERS`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from swimm3r.localization.landmarks import MIN_INLIERS
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.colmap.absolute_pose import absolute_pose
from swimm3r.sim3 import Sim3
from swimm3r.visits.alignment.matches import VisitMatches


@dataclass(frozen=True)
class Localized:
    """One frame with a pose in the other visit's model."""

    a_from_b: Sim3  # by this frame alone
    rows: Int[np.ndarray, " n"]  # of the matches: those that agree with the pose


def localized_frames(a: Reconstruction, b: Reconstruction, matches: VisitMatches, max_error: float) -> list[Localized]:
    """The frames of both visits that can be localized in the other one, those with the most matches first.

    `max_error` is in pixels. A point may be in several matches, of several pairs of frames.
    """
    found = [*_frames_of(b, a, matches.reversed(), max_error)]
    back = _frames_of(a, b, matches, max_error)
    found += [Localized(each.a_from_b.inverse(), each.rows) for each in back]
    return sorted(found, key=lambda each: -len(each.rows))


def among(matches: VisitMatches, localized: Sequence[Localized]) -> Bool[np.ndarray, " n"]:
    """True for matches that agree with the pose of a localized frame."""
    found = np.zeros(len(matches), bool)
    for each in localized:
        found[each.rows] = True
    return found


def _frames_of(
    rec: Reconstruction, other: Reconstruction, matches: VisitMatches, max_error: float
) -> Iterator[Localized]:
    """The frames of `rec`, the first visit of these matches, localized in `other`; similarities are onto `other`."""
    own, world = (r.points.xyz.double() for r in (rec, other))
    for frame in np.unique(matches.frame_a).tolist():
        rows = _once(np.flatnonzero(matches.frame_a == frame), matches)
        if len(rows) < MIN_INLIERS:
            continue
        xyz = world[matches.point_b[rows]]
        estimate = absolute_pose(torch.from_numpy(matches.xy_a[rows]), xyz, rec.cameras[frame], max_error)
        if estimate is None or int(estimate[1].sum()) < MIN_INLIERS:
            continue
        pose, agree = estimate
        here = rec.cameras.cam2world[frame].double()
        similarity = _similarity(here, pose, own[matches.point_a[rows]][agree], xyz[agree])
        if similarity is not None:
            yield Localized(similarity, rows[agree.numpy()])


def _similarity(
    own: Float[Tensor, "4 4"], pose: Float[Tensor, "4 4"], xyz: Float[Tensor, "n 3"], there: Float[Tensor, "n 3"]
) -> Sim3 | None:
    """The similarity that carries a pose `own` to `pose`, and points `xyz` to `there`; None for points behind it."""
    z, z_there = ((points - at[:3, 3]) @ at[:3, 2] for points, at in ((xyz, own), (there, pose)))
    front = (z > 0) & (z_there > 0)
    if not bool(front.any()):
        return None
    scale = float((z_there[front] / z[front]).median())
    R = (pose[:3, :3] @ own[:3, :3].mT).numpy()
    return Sim3(scale, R, pose[:3, 3].numpy() - scale * R @ own[:3, 3].numpy())


def _once(rows: Int[np.ndarray, " n"], matches: VisitMatches) -> Int[np.ndarray, " k"]:
    """The rows without repetitions of a point of the other visit at one keypoint, which several of its frames match."""
    keys = np.column_stack([matches.xy_a[rows], matches.point_b[rows]])
    return rows[np.sort(np.unique(keys, axis=0, return_index=True)[1])]
