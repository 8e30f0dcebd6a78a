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
from scipy.spatial import KDTree
from torch import Tensor

from swimm3r.cameras import Cameras, unproject
from swimm3r.io.colmap.model import silence_log
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.colmap.absolute_pose import absolute_pose
from swimm3r.sfm.features.sift import extract_features, match_descriptors, unit_descriptors
from swimm3r.sfm.settings import FeatureSettings

MIN_INLIERS = 12
"""Landmarks that agree on a pose before it is believed: 6 of them fix it, and wrong matches agree on a few more."""
_MAX_ERROR = 4.0  # pixels of an image of 1000; never less than _LEAST_ERROR
_LEAST_ERROR = 2.5
_SAME_KEYPOINT = 1.0  # pixels between an observation and the keypoint that it is


@dataclass(frozen=True)
class Landmarks:
    """The points that one registered frame shows."""

    descriptors: Float[Tensor, "n 128"]  # of unit length
    xyz: Float[Tensor, "n 3"]  # world


@dataclass(frozen=True)
class Located:
    """An image's pose and how many landmarks agree on it."""

    cam2world: Float[Tensor, "4 4"]
    inliers: int


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
        xyz = _measured(rec, name, keypoints)
        mine = rec.tracks.frame == rec.index(name)
        observations, points = rec.tracks.xy[mine].double(), rec.tracks.point[mine]
        if len(observations) and len(keypoints):
            distance, row = KDTree(observations.numpy()).query(keypoints.numpy())
            near = torch.from_numpy(distance < _SAME_KEYPOINT)
            xyz[near] = rec.points.xyz[points[torch.from_numpy(row)[near]]].double()
        placed = torch.isfinite(xyz).all(-1)
        return Landmarks(unit_descriptors(found.descriptors)[placed], xyz[placed])

    return of


def _measured(rec: Reconstruction, name: str, pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "n 3"]:
    """The surface at pixels of a frame, world axes; not a number where no depth was measured."""
    if name not in rec.depth or not len(pixels):
        return torch.full((len(pixels), 3), torch.nan, dtype=torch.float64)
    z_depth = rec.depth[name].z_depth.double()
    height, width = z_depth.shape
    column = (pixels[:, 0] * width / rec.cameras.width).long().clamp(0, width - 1)
    row = (pixels[:, 1] * height / rec.cameras.height).long().clamp(0, height - 1)
    z = z_depth[row, column]
    camera = rec.cameras[rec.index(name)]
    return unproject(camera, pixels[None], torch.where(z > 0, z, torch.nan)[None])[0]


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
    return Located(estimate[0], int(estimate[1].sum()))
