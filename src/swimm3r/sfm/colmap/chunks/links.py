"""The similarity between two parts of a clip, from points that both have: RANSAC over reprojections.

A similarity is judged in pixels, where errors are alike for near and far points: a point of part a, moved to part b,
must project onto the feature that sees it there, and the other way round.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from swimm3r.sfm.colmap.chunks.parts import Part, SharedPoints
from swimm3r.sim3 import Sim3, fit_similarity

if TYPE_CHECKING:
    import pycolmap

MAX_ERROR = 8.0  # pixels; each part has its own small bends, which the adjustment of all of them takes out
_TRIALS = 300
_SAMPLE = 600  # shared points that judge a trial
_LEAST = 25  # shared points that agree
_LEAST_SHARE = 0.3
_REFITS = 4


@dataclass(frozen=True)
class Link:
    """Two parts that share points under one similarity."""

    a: int
    b: int
    b_from_a: Sim3
    xyz_a: Float[np.ndarray, "n 3"]  # points that agree, in the axes of part a
    xyz_b: Float[np.ndarray, "n 3"]
    depth_b: Float[np.ndarray, " n"]  # z depth in the frame of part b that observes them
    support: int  # how many agree; the arrays may be a sample

    def inverse_to(self, part: int) -> "Sim3":
        """The similarity onto `part` from the other one."""
        return self.b_from_a if part == self.b else self.b_from_a.inverse()


def link(
    a: int, b: int, parts: list[Part], shared: SharedPoints, pixels: dict[int, np.ndarray], camera: "pycolmap.Camera"
) -> Link | None:
    """The link of two parts, None where too few of their shared points agree on a similarity."""
    if len(shared) < _LEAST:
        return None
    view = _View(parts[a], parts[b], shared, pixels, camera)
    rng = np.random.default_rng([a, b])
    judged = rng.permutation(len(shared))[:_SAMPLE]
    best, most = None, 0
    for _ in range(_TRIALS):
        three = rng.choice(len(judged), 3, replace=False)
        trial = fit_similarity(view.xyz_a[judged[three]], view.xyz_b[judged[three]])
        if trial is None:
            continue
        agree = int((view.errors(trial, judged) < MAX_ERROR).sum())
        if agree > most:
            best, most = trial, agree
    if best is None or most < 3:
        return None
    everything = np.arange(len(shared))
    inliers = view.errors(best, everything) < MAX_ERROR
    for _ in range(_REFITS):
        refit = fit_similarity(view.xyz_a[inliers], view.xyz_b[inliers], 1 / view.depth_b[inliers] ** 2)
        if refit is None:
            break
        again = view.errors(refit, everything) < MAX_ERROR
        if again.sum() < inliers.sum():
            break
        best, inliers = refit, again
    support = int(inliers.sum())
    if support < _LEAST or support < _LEAST_SHARE * len(shared):
        return None
    kept = rng.permutation(np.flatnonzero(inliers))[:100]
    return Link(a, b, best, view.xyz_a[kept], view.xyz_b[kept], view.depth_b[kept], support)


class _View:
    """Shared points of two parts with the cameras that observe them."""

    def __init__(
        self, a: Part, b: Part, shared: SharedPoints, pixels: dict[int, np.ndarray], camera: "pycolmap.Camera"
    ) -> None:
        self.xyz_a, self.xyz_b = a.xyz[shared.a], b.xyz[shared.b]
        self._pose_a, self._pose_b = (
            np.stack([part.cam_from_world[i] for i in images.tolist()])
            for part, images in ((a, shared.image_a), (b, shared.image_b))
        )
        self._xy_a, self._xy_b = (
            np.stack([pixels[i][f] for i, f in zip(images.tolist(), features.tolist(), strict=True)])
            for images, features in ((shared.image_a, shared.feature_a), (shared.image_b, shared.feature_b))
        )
        self._camera = camera
        self.depth_b = np.maximum(_local(self._pose_b, self.xyz_b)[:, 2], 1e-9)

    def errors(self, b_from_a: Sim3, rows: np.ndarray) -> Float[np.ndarray, " n"]:
        """The larger of both reprojection errors of each shared point, pixels."""
        there = self._missed(self._pose_b[rows], b_from_a(self.xyz_a[rows]), self._xy_b[rows])
        back = self._missed(self._pose_a[rows], b_from_a.inverse()(self.xyz_b[rows]), self._xy_a[rows])
        return np.maximum(there, back)

    def _missed(self, poses: np.ndarray, xyz: np.ndarray, xy: np.ndarray) -> Float[np.ndarray, " n"]:
        local = _local(poses, xyz)
        front: Bool[np.ndarray, " n"] = local[:, 2] > 0
        missed = np.full(len(xyz), np.inf)
        missed[front] = np.linalg.norm(self._camera.img_from_cam(local[front]) - xy[front], axis=1)
        return missed


def _local(poses: Float[np.ndarray, "n 3 4"], xyz: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    return np.einsum("nij,nj->ni", poses[:, :, :3], xyz) + poses[:, :, 3]
