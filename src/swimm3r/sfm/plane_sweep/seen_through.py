"""Depth that other frames look through.

Windows put surfaces that stand in front of others a few pixels beyond their silhouettes, in all frames alike, so that
neighboring frames confirm such depth. Frames that look past the surface from elsewhere measured what lies behind, on a
ray through these points. Differences that are usual between two frames say nothing.
"""

from collections.abc import Iterable

import numpy as np
import torch

from swimm3r.cameras import Cameras
from swimm3r.sfm.plane_sweep.consistency import depth_beyond
from swimm3r.sfm.plane_sweep.settings import PlaneSweepSettings
from swimm3r.sfm.plane_sweep.sweep import RawDepth, transfer

_BEHIND = 0.07  # share of a depth, from which a surface behind a point is another one
_USUAL = 5.0  # times the median difference between two frames' depths, which it must be, too
_ALIKE = 2.0  # times that median, within which two frames show the same surface


def without_seen_through(
    depth: RawDepth, others: Iterable[RawDepth], cameras: Cameras, settings: PlaneSweepSettings
) -> RawDepth:
    """The depth of a frame without the points that others look through; `cameras` are its own and then the others'.

    A point goes where more than `settings.most_behind` times as many frames measured a surface more than 7 % behind it
    as measured the point to `settings.tolerance`, the frame itself among them. Where two frames' depths usually differ
    by more than 1.4 %, five times that takes the place of 7 %, and twice that may be the tolerance.
    """
    q = depth.inverse_depth.numpy()
    (K, *Ks), (pose, *poses) = cameras.K.numpy(), cameras.world2cam.numpy()
    measured, through = np.ones(q.shape, np.int32), np.zeros(q.shape, np.int32)
    for other, K_other, pose_other in zip(others, Ks, poses, strict=True):
        beyond = depth_beyond(q, other.inverse_depth.numpy(), *transfer(K, pose, K_other, pose_other))
        known, behind = beyond > 0, beyond - 1
        usual = float(np.median(np.abs(behind[known]))) if known.any() else 0.0
        measured += known & (np.abs(behind) <= max(settings.tolerance, _ALIKE * usual))
        through += known & (behind > max(_BEHIND, _USUAL * usual))
    gone = torch.from_numpy(through > settings.most_behind * measured)
    return RawDepth(depth.inverse_depth.masked_fill(gone, 0), depth.correlation.masked_fill(gone, 0))
