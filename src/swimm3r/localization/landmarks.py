"""Pose of an image from pixels that match points of the reconstruction: PnP with RANSAC over SIFT.

A *landmark* is a keypoint of a registered frame whose place is known: that of the triangulated point whose observation
it is, else that of its pixel's measured depth. (At the end of a strip of stills two frames share little ground, and a
third frame, with which points could have been triangulated there, none of it.) An image's keypoints are matched with
the landmarks of frames that may show the same place; its pose reprojects most of them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.cameras import Cameras, unproject
from swimm3r.io.colmap.model import silence_log
from swimm3r.localization.keypoint_places import measured_depth, tracked_points
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.colmap.absolute_pose import absolute_pose
from swimm3r.sfm.features.settings import FeatureSettings
from swimm3r.sfm.features.sift import extract_features, match_descriptors, unit_descriptors

MIN_INLIERS = 12
"""Landmarks that agree on a pose before it is believed: 6 of them fix it, and wrong matches agree on a few more."""
_MAX_ERROR = 4.0  # pixels of an image of 1000; never less than _LEAST_ERROR
_LEAST_ERROR = 2.5


@dataclass(frozen=True)
class Landmarks:
    """The points that one registered frame shows."""

    descriptors: Float[Tensor, "n 128"]  # of unit length
    xyz: Float[Tensor, "n 3"]  # world


@dataclass(frozen=True)
class Located:
    """An image's pose and the landmarks that agree on it."""

    cam2world: Float[Tensor, "4 4"]
    pixels: Float[Tensor, "k 2"]  # of the image's keypoints
    points: Float[Tensor, "k 3"]  # where they are, world

    @property
    def inliers(self) -> int:
        """Their number."""
        return len(self.pixels)


def landmarks_of(
    rec: Reconstruction, frames: Frames, settings: FeatureSettings, keep: int = 64
) -> Callable[[str], Landmarks]:
    """The landmarks of a registered frame by its name; those of the last `keep` frames asked for are remembered."""

    silence_log()

    @lru_cache(maxsize=keep)
    def of(name: str) -> Landmarks:
        f = frames.index(name)
        found = extract_features(frames.image(f), frames.mask(f), settings)
        keypoints = torch.from_numpy(found.keypoints[:, :2]).double()
        i, z = rec.index(name), measured_depth(rec, name, keypoints)
        xyz = unproject(rec.cameras[i], keypoints[None], torch.where(z > 0, z, torch.nan)[None])[0]
        point = tracked_points(rec, i, keypoints)
        xyz[point >= 0] = rec.points.xyz[point[point >= 0]].double()
        placed = torch.isfinite(xyz).all(-1)
        return Landmarks(unit_descriptors(found.descriptors)[placed], xyz[placed])

    return of


def locate(
    image: Float[Tensor, "h w 3"],
    mask: Bool[Tensor, "h w"],
    lens: Cameras,
    near: Sequence[Landmarks],
    settings: FeatureSettings,
) -> Located | None:
    """The pose of an image taken through `lens` (one camera, its pose unused); None where too few landmarks agree."""
    found = extract_features(image, mask, settings)
    described = unit_descriptors(found.descriptors)
    keypoints = torch.from_numpy(found.keypoints[:, :2]).double()
    pixels, points = [], []
    for landmarks in near:
        pairs = match_descriptors(described, landmarks.descriptors, settings.max_ratio)
        pixels.append(keypoints[pairs[:, 0]])
        points.append(landmarks.xyz[pairs[:, 1]])
    if sum(len(part) for part in pixels) < MIN_INLIERS:
        return None
    max_error = max(_LEAST_ERROR, _MAX_ERROR * max(lens.width, lens.height) / 1000)
    # one point seen by several frames counts once
    both = torch.unique(torch.cat([torch.cat(pixels), torch.cat(points)], -1), dim=0)
    estimate = absolute_pose(both[:, :2], both[:, 2:], lens, max_error)
    if estimate is None or int(estimate[1].sum()) < MIN_INLIERS:
        return None
    cam2world, agree = estimate
    return Located(cam2world, both[agree, :2], both[agree, 2:])
