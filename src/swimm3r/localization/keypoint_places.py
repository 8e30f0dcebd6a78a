"""Places of the keypoints of a registered frame: the triangulated points that they observe, and measured depth."""

import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from swimm3r.scene.reconstruction import Reconstruction

_SAME_KEYPOINT = 1.0  # pixels between an observation and the keypoint that it is


def tracked_points(rec: Reconstruction, i: int, pixels: Float[Tensor, "k 2"]) -> Int[Tensor, " k"]:
    """The point that each keypoint of frame i observes; -1 of others."""
    mine = (rec.tracks.frame == i).nonzero()[:, 0]
    if not len(mine) or not len(pixels):
        return torch.full((len(pixels),), -1)
    off, row = KDTree(rec.tracks.xy[mine].double().numpy()).query(pixels.numpy())
    same = torch.from_numpy(off < _SAME_KEYPOINT)
    return torch.where(same, rec.tracks.point[mine[torch.from_numpy(row)]], -1)


def measured_depth(rec: Reconstruction, name: str, pixels: Float[Tensor, "k 2"]) -> Float[Tensor, " k"]:
    """z depth at pixels of a frame, scene units; 0 where none was measured."""
    if name not in rec.depth:
        return torch.zeros(len(pixels), dtype=torch.float64)
    z_depth = rec.depth[name].z_depth
    column, row = pixels.long().unbind(-1)
    return z_depth[row.clamp(0, z_depth.shape[0] - 1), column.clamp(0, z_depth.shape[1] - 1)].double()
