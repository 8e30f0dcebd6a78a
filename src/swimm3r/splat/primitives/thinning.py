"""Points thinned: to one per voxel, or to one per cell of the images that show them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

_CLOSE = 0.01  # of the number of points that is wanted
_CELLS = (0.25, 256.0)  # px, least and largest edge


@dataclass(frozen=True)
class Shown:
    """Points that one image shows."""

    index: Int[np.ndarray, " m"]  # among the points
    pixels: Float[np.ndarray, "m 2"]  # inside the image


def voxel_sample(points: Float[Tensor, "p 3"], target: int) -> Int[Tensor, " n"]:
    """One point per occupied voxel, the nearest to its voxel's mean; the edge is bisected until about `target` remain.

    All points where there are no more than `target`, none for 0; within 1 % of it where the points allow, else more.
    """
    if target == 0:
        return torch.zeros(0, dtype=torch.int64)
    if len(points) <= target:
        return torch.arange(len(points))
    extent = float((points.amax(0) - points.amin(0)).max())
    low, high = extent * 1e-6, extent
    for _ in range(40):
        edge = (low * high) ** 0.5
        voxel = _voxels(points, edge)
        found = int(voxel.max()) + 1
        if abs(found - target) <= 0.01 * target:
            break
        low, high = (edge, high) if found > target else (low, edge)
    else:
        voxel = _voxels(points, low)
    count = torch.bincount(voxel)
    mean = torch.zeros(len(count), 3, dtype=points.dtype).index_add_(0, voxel, points) / count[:, None]
    distance = (points - mean[voxel]).square().sum(-1)
    order = torch.argsort(distance, stable=True)
    nearest_first = order[torch.argsort(voxel[order], stable=True)]
    return nearest_first[count.cumsum(0) - count]


def _voxels(points: Float[Tensor, "p 3"], edge: float) -> Int[Tensor, " p"]:
    """The number of each point's voxel, counted over the occupied ones."""
    cell = ((points - points.amin(0)) / edge).long()
    size = cell.amax(0) + 1
    return torch.unique((cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2], return_inverse=True)[1]


def covering_sample(count: int, target: int, images: Sequence[Shown]) -> Int[Tensor, " n"]:
    """About `target` of `count` points, with as many pixels of each image for each of them.

    Images have square cells, whose edge is bisected. Image by image, a cell that shows none of the points chosen so far
    gets the one nearest to its middle. All that any image shows where these are no more than `target`.
    """
    low, high = _CELLS
    for _ in range(16):
        edge = (low * high) ** 0.5
        chosen = _covering(count, images, edge)
        found = int(chosen.sum())
        if abs(found - target) <= _CLOSE * target:
            break
        low, high = (edge, high) if found > target else (low, edge)
    return torch.from_numpy(np.flatnonzero(chosen))


def _covering(count: int, images: Sequence[Shown], edge: float) -> Bool[np.ndarray, " count"]:
    chosen = np.zeros(count, dtype=bool)
    for image in images:
        if not len(image.index):
            continue
        place = (image.pixels / edge).astype(np.int64)
        cell = place[:, 1] * (place[:, 0].max() + 1) + place[:, 0]
        covered = np.zeros(cell.max() + 1, dtype=bool)
        covered[cell[chosen[image.index]]] = True
        open_ = np.flatnonzero(~covered[cell])
        off = np.square(image.pixels[open_] - (place[open_] + 0.5) * edge).sum(1)
        order = open_[np.lexsort((off, cell[open_]))]
        first = np.append(True, np.diff(cell[order]) > 0)[: len(order)]
        chosen[image.index[order[first]]] = True
    return chosen
