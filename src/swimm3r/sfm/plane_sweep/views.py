"""Inputs of the plane sweep: the frames to compare, the range of depths, and undistorted images of one size.

Sweeping needs straight epipolar lines, so the work is done on a pinhole canvas at working size; depth along the optical
axis is the same number on both grids, and `on_frame_grid` reads it back at every pixel of the distorted frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import sparse
from torch import Tensor

from swimm3r.cameras import Cameras, project, project_visible
from swimm3r.imaging.filters import texture
from swimm3r.imaging.gray import strongest, texture_moments
from swimm3r.imaging.undistortion import pinhole_grid, undistorted
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.plane_sweep import consistency

_FEWEST_POINTS = 8  # in a frame, to know its depth range
_CANDIDATES = 40  # frames sharing most points that are considered as sources
_NO_ANGLE = 0.01  # degrees
_WEIGHED = 8  # frames, of which the weights of the channels are taken


@dataclass(frozen=True)
class SweepView:
    """An image as the sweep sees it: gray, undistorted, at working size."""

    gray: Float[Tensor, "h w"]
    detail: Float[Tensor, "h w"]  # gray without what varies slowly: veil and vignetting move with the camera
    seen: Bool[Tensor, "h w"]  # inside the image and its mask
    K: Float[Tensor, "3 3"]
    world2cam: Float[Tensor, "4 4"]


def choose_sources(rec: Reconstruction, count: int, angle_deg: float) -> list[list[int]]:
    """For each frame the frames to compare it with, best first: each adds most to how well the shared points are seen.

    A point counts by its triangulation angle (a bell around `angle_deg`, three times wider above), fully where both
    frames track it, a quarter where it only falls into the image, and less the better it is covered already.
    """
    xyz, centers = rec.points.xyz.double(), rec.cameras.centers.double()
    points = points_by_frame(rec)
    frame = np.repeat(np.arange(len(points)), [len(mine) for mine in points])
    ones = np.ones(len(frame), np.float32)
    seen_by = sparse.csc_matrix((ones, (frame, np.concatenate(points))), (len(points), max(len(xyz), 1)))
    chosen: list[list[int]] = []
    for i in range(len(rec.names)):
        mine = points[i]
        others, shared = np.unique(seen_by[:, mine].indices, return_counts=True)
        others, shared = others[others != i], shared[others != i]
        near_by = [int(j) for j in others[np.argsort(-shared, kind="stable")[:_CANDIDATES]]]
        chosen.append([])
        if not near_by:
            continue
        P = xyz[mine]
        to_me = torch.nn.functional.normalize(centers[i] - P, dim=-1)
        to_them = torch.nn.functional.normalize(centers[near_by][:, None] - P, dim=-1)
        angle = torch.rad2deg(torch.arccos((to_me * to_them).sum(-1).clamp(-1, 1)))
        width = torch.where(angle < angle_deg, 0.4 * angle_deg, 1.2 * angle_deg)
        _, _, inside = project_visible(rec.cameras[near_by], P.expand(len(near_by), -1, -1))
        both = torch.from_numpy(np.stack([_contains(points[j], mine) for j in near_by]))
        weight = torch.exp(-0.5 * ((angle - angle_deg) / width) ** 2)
        weight[angle.amax(-1) < _NO_ANGLE] = 0  # from the same place, as facets of one frame
        weight = weight * torch.where(both, 1.0, torch.where(inside, 0.25, 0.0))
        covered = torch.zeros(len(mine), dtype=torch.float64)
        for _ in range(min(count, len(near_by))):
            gain = (weight / (0.5 + covered)).sum(-1)
            best = int(gain.argmax())
            if gain[best] <= 0:
                break
            chosen[i].append(near_by[best])
            covered = covered + weight[best]
            weight[best] = 0
    return chosen


def _contains(ascending: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """The mask of those wanted that are in the other list."""
    at = np.searchsorted(ascending, wanted).clip(max=len(ascending) - 1)
    return ascending[at] == wanted


def points_by_frame(rec: Reconstruction) -> list[np.ndarray]:
    """The points that each frame sees, in ascending order."""
    count = max(1, len(rec.points.xyz))
    frame, point = np.divmod(np.unique(rec.tracks.frame.numpy() * count + rec.tracks.point.numpy()), count)
    return np.split(point, np.searchsorted(frame, np.arange(1, len(rec.names))))


def depth_range(rec: Reconstruction, i: int, points: np.ndarray) -> tuple[float, float] | None:
    """The z depths to search in frame i, from the points it sees with a margin; None where they are too few.

    The far end lies well behind the points: open water holds none, and what stands in it may still be matched.
    """
    mine = torch.from_numpy(points)
    z = project(rec.cameras[i], rec.points.xyz[mine][None])[1]
    z = z[z > 0].numpy()
    if len(z) < _FEWEST_POINTS:
        return None
    low, high = np.quantile(z, [0.01, 0.99])
    return float(low) / 1.4, float(high) * 2.5


def gray_weights(frames: Frames, names: Sequence[str], long_side: int) -> Float[Tensor, "3"]:
    """Weights of red, green and blue for the gray images in which the detail of frames stands out most from noise.

    A lamp in deep water shows nearly all detail in blue, of which luma takes a ninth.
    """
    moments = np.zeros((3, 3))
    for name in names[:: max(1, -(-len(names) // _WEIGHED))]:
        k = frames.index(name)
        moments += texture_moments(frames.image(k), frames.mask(k), long_side)
    return strongest(moments)


def make_view(
    gray: Float[Tensor, "h w"],
    mask: Bool[Tensor, "h w"],
    lens: Cameras,
    canvas: Cameras,
    turn: Float[Tensor, "3 3"] | None = None,
) -> SweepView:
    """A frame undistorted onto the canvas; `lens` is its own camera, `canvas` the pinhole one and `turn` its axes."""
    values, shown = undistorted(gray, mask, lens, canvas, turn)
    detail = torch.from_numpy(texture(values.numpy(), shown.numpy()))
    return SweepView(values, detail, shown, canvas.K[0], canvas.world2cam[0])


def halved(view: SweepView) -> SweepView:
    """The view at half its size; its sides are even."""

    def mean(values: Tensor) -> Tensor:
        return torch.nn.functional.avg_pool2d(values[None, None].float(), 2)[0, 0]

    K = torch.diag(torch.tensor([0.5, 0.5, 1.0], dtype=view.K.dtype)) @ view.K
    return SweepView(mean(view.gray), mean(view.detail), mean(view.seen) > 0.999, K, view.world2cam)


def likely_edge(gray: Float[Tensor, "h w"]) -> float:
    """A change of gray that makes a depth edge likely: 0.8 of the contrast that windows of 9 pixels usually have."""
    window = min(9, *gray.shape)
    mean, square = (torch.nn.functional.avg_pool2d(g[None, None], window, stride=4) for g in (gray, gray * gray))
    return max(2 / 255, 0.8 * float((square - mean * mean).clamp(min=0).sqrt().median()))


def on_frame_grid(
    values: Float[Tensor, "h w"],
    also: Float[Tensor, "h w"],
    guide: Float[Tensor, "h w"],
    wanted: Float[Tensor, "fh fw"],
    lens: Cameras,
    canvas: Cameras,
    turn: Float[Tensor, "3 3"] | None = None,
) -> tuple[Float[Tensor, "fh fw"], Float[Tensor, "fh fw"]]:
    """`values` and `also` of the canvas at the pixels of the frame, along edges of the gray image; 0 = unknown.

    The gray image is `guide` on the canvas and `wanted` on the frame's own grid.
    """
    u, v = pinhole_grid(lens, canvas, turn)
    out, read = consistency.look_up(
        values.numpy(), also.numpy(), guide.numpy(), u, v, wanted.numpy().ravel(), likely_edge(guide), 0.03
    )
    return torch.from_numpy(out.reshape(wanted.shape)), torch.from_numpy(read.reshape(wanted.shape))
