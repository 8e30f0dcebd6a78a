"""The points of a reconstruction with their descriptors: the map that a camera is tracked in.

A landmark is a keypoint of a registered frame with a known place in the world: that of the triangulated point it is an
observation of. A reconstruction without tracks at its keypoints (of a network, of another program) gives the place from
its depth maps.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from swimm3r.cameras import Cameras, project, project_visible, unproject
from swimm3r.errors import InputError
from swimm3r.imaging.rectification import Rectification
from swimm3r.io.colmap.model import silence_log
from swimm3r.localization.keypoint_places import measured_depth, tracked_points
from swimm3r.localization.lenses import has_several_lenses
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.features import vlad
from swimm3r.sfm.features.settings import FeatureSettings
from swimm3r.sfm.features.sift import Features, extract_features, unit_descriptors

_LEAST_TRACKED = 50  # landmarks of a mean frame with tracks; below, depth maps take their place
_TURNED_AWAY = 0.7  # cosine of the angle between two views of a point beyond which SIFT no longer finds it again


@dataclass(frozen=True)
class LandmarkMap:
    """Points in the world and how registered frames saw them."""

    cameras: Cameras  # of the registered frames
    metric: bool
    xyz: Float[Tensor, "p 3"]  # world
    point: Int[Tensor, " n"]  # of each landmark
    frame: Int[Tensor, " n"]  # that saw it; sorted
    descriptors: UInt8[Tensor, "n 128"]  # as stored
    words: Float[Tensor, "k 128"]  # visual words of the retrieval
    looks: Float[Tensor, "c d"]  # VLAD descriptors of the frames
    distance: float  # median z depth of landmarks in the frames that saw them
    rectification: Rectification | None = None  # of images as the camera takes them, where the run rectified its frames
    several_lenses: bool = False  # of the cameras of a rig: images come with the lens of theirs
    rows_rectified: bool = False  # the camera turned while it exposed the frames' rows, which were redrawn

    def alike(self, descriptors: Float[Tensor, "m 128"], count: int) -> list[int]:
        """The frames that look most like an image with these descriptors, the likest first."""
        if not len(descriptors):
            return []
        likeness = self.looks @ vlad.summed(descriptors, self.words)
        return torch.argsort(likeness, descending=True, stable=True)[:count].tolist()

    def described(self, rows: Int[Tensor, " m"]) -> Float[Tensor, "m 128"]:
        """Descriptors of landmarks, of unit length."""
        return unit_descriptors(self.descriptors[rows].numpy())

    def of_frame(self, frame: int) -> Int[Tensor, " m"]:
        """The landmarks of a frame."""
        return (self.frame == frame).nonzero()[:, 0]

    def visible(self, camera: Cameras, frames: int) -> Int[Tensor, " m"]:
        """Landmarks that a camera (one) should see: of the `frames` frames that share most with it, a point once.

        Points count that lie inside its image and were seen from within 45 degrees of its own direction.
        """
        inside = project_visible(camera, self.xyz[None])[2][0]
        rows = inside[self.point].nonzero()[:, 0]
        points = self.xyz[self.point[rows]]
        now, then = points - camera.centers[0], points - self.cameras.centers[self.frame[rows]]
        cosine = torch.nn.functional.cosine_similarity(now, then, dim=-1)
        rows = rows[cosine > _TURNED_AWAY]
        shared = torch.bincount(self.frame[rows], minlength=len(self.cameras))
        best = torch.argsort(shared, descending=True, stable=True)[:frames]
        rank = torch.full((len(self.cameras),), len(self.cameras))
        rank[best] = torch.arange(len(best))
        rows = rows[rank[self.frame[rows]] < len(best)]
        rows = rows[torch.argsort(rank[self.frame[rows]], stable=True)]
        _, first = np.unique(self.point[rows].numpy(), return_index=True)
        return rows[torch.from_numpy(np.sort(first))]


def landmark_map(
    rec: Reconstruction, frames: Frames, settings: FeatureSettings, progress: Progress = silent
) -> LandmarkMap:
    """The landmarks of all registered frames. Raises InputError where there are none.

    `settings` are those that found the reconstruction's keypoints, so that they are found again.
    """
    silence_log()
    found: list[Features] = []
    for i, name in enumerate(rec.names):
        progress("describing the map", i, len(rec.names))
        f = frames.index(name)
        found.append(extract_features(frames.image(f), frames.mask(f), settings))
    progress("describing the map", len(rec.names), len(rec.names))
    pixels = [torch.from_numpy(one.keypoints[:, :2]).double() for one in found]
    xyz, points = rec.points.xyz.double(), [tracked_points(rec, i, each) for i, each in enumerate(pixels)]
    if sum(int((each >= 0).sum()) for each in points) < _LEAST_TRACKED * len(rec.names):
        xyz, points = _points_by_depth(rec, pixels)
    known = [each >= 0 for each in points]
    if not any(bool(each.any()) for each in known):
        raise InputError(
            "the reconstruction has no points that images could be matched with",
            cause="it was imported without points and depth maps, or its images changed",
            hint="swimm3r run on the images, which makes them",
        )
    descriptors = [unit_descriptors(one.descriptors) for one in found]
    words = vlad.vocabulary([each for each in descriptors if len(each)], torch.Generator().manual_seed(0))
    unlike = torch.zeros(words.numel())
    point = torch.cat([each[k] for each, k in zip(points, known, strict=True)])
    stored = [torch.from_numpy(one.descriptors)[k] for one, k in zip(found, known, strict=True)]
    frame = torch.cat([torch.full((int(k.sum()),), i) for i, k in enumerate(known)])
    return LandmarkMap(
        cameras=rec.cameras,
        metric=rec.metric,
        xyz=xyz,
        point=point,
        frame=frame,
        descriptors=torch.cat(stored),
        words=words,
        looks=torch.stack([vlad.summed(each, words) if len(each) else unlike for each in descriptors]),
        distance=_median_depth(rec.cameras, xyz, point, frame),
        several_lenses=has_several_lenses(rec, frames),
        rows_rectified=frames.rows_rectified,
    )


def _points_by_depth(
    rec: Reconstruction, keypoints: Sequence[Float[Tensor, "_ 2"]]
) -> tuple[Float[Tensor, "p 3"], list[Int[Tensor, " k"]]]:
    """A point for every keypoint at which a depth map knows the depth, and the keypoints' points."""
    xyz, points, count = [], [], 0
    for i, (name, pixels) in enumerate(zip(rec.names, keypoints, strict=True)):
        z = measured_depth(rec, name, pixels)
        known = z > 0
        point = torch.full((len(pixels),), -1)
        point[known] = torch.arange(count, count + int(known.sum()))
        count += int(known.sum())
        points.append(point)
        xyz.append(unproject(rec.cameras[i], pixels[known][None], z[known][None])[0])
    return torch.cat(xyz), points


def _median_depth(
    cameras: Cameras, xyz: Float[Tensor, "p 3"], point: Int[Tensor, " n"], frame: Int[Tensor, " n"]
) -> float:
    z = [project(cameras[i], xyz[point[frame == i]][None])[1][0] for i in range(len(cameras))]
    return float(torch.cat(z).median())
