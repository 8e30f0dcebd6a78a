"""The surface of a dive in cells, with their area counted in images.

A piece of surface counts by the share of an image that it fills from where it was filmed best, but as from the median
depth at least. So ground that was only seen from afar counts little, and a number per image's area is one per pixel.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from swimm3r.scene.reconstruction import Reconstruction

_CELLS = 8  # edges of a surface cell in the median depth


@dataclass(frozen=True)
class Surface:
    """The surface of a dive in cells."""

    xyz: Float[Tensor, "n 3"]  # of their centers, float64, scene units
    area: Float[Tensor, " n"]  # of each, in images
    edge: float  # of a cell, scene units

    def cells_of(self, points: Float[Tensor, "m 3"]) -> Int[Tensor, " m"]:
        """The cell that holds each point; -1 for those in none."""
        places, low, size = _places(self.xyz, self.edge)
        asked = (points.double() / self.edge).floor().long() - low
        inside = ((asked >= 0) & (asked < size)).all(1)
        keys, order = _keys(places, size).sort()
        key = _keys(asked.clamp(min=0).minimum(size - 1), size)
        found = torch.searchsorted(keys, key).clamp(max=len(keys) - 1)
        return torch.where(inside & (keys[found] == key), order[found], -1)


def _places(xyz: Float[Tensor, "n 3"], edge: float) -> tuple[Int[Tensor, "n 3"], Int[Tensor, "3"], Int[Tensor, "3"]]:
    """The whole-numbered places of cells from the lowest on, the lowest, and how many places there are."""
    places = (xyz / edge).floor().long()
    low = places.amin(0)
    return places - low, low, places.amax(0) - low + 1


def _keys(places: Int[Tensor, "n 3"], size: Int[Tensor, "3"]) -> Int[Tensor, " n"]:
    return (places[:, 0] * size[1] + places[:, 1]) * size[2] + places[:, 2]


def surface_of(rec: Reconstruction, median_depth: float, points: Float[Tensor, "n 3"] | None = None) -> Surface:
    """These points, else the dense cloud or the sparse points, as cells of an eighth of the median depth."""
    if points is None:
        points = rec.points.xyz if rec.cloud is None else rec.cloud.xyz
    edge = median_depth / _CELLS
    cells = (torch.unique((points.double() / edge).floor().long(), dim=0).double() + 0.5) * edge
    fx, fy = rec.cameras.K[:, [0, 1], [0, 1]].double().mean(0).tolist()
    image = rec.cameras.width / fx * rec.cameras.height / fy * median_depth**2
    nearest, _ = KDTree(rec.cameras.centers.double().numpy()).query(cells.numpy())
    away = torch.from_numpy(nearest).clamp(min=median_depth)
    return Surface(cells, edge**2 / image * (median_depth / away).square(), edge)
