"""The plan of a map in blocks: the ground cut into windows of equal area, with a margin around each, and their turns.

Area is counted in images: a piece of surface counts by the share of an image that it fills from where it was filmed
best, but as from the median depth at least. So ground that was only seen from afar counts little, and a number of
primitives per image's area is one per pixel.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.splat.ground import Window, plane_of
from swimm3r.splat.settings import BlockSettings

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


@dataclass(frozen=True)
class PlannedBlock:
    """One block's ground, and its turn: those of one turn have no common border, and those of earlier ones are done."""

    window: Window
    margin: float  # scene units, trained with the block and then left out
    area: float  # in images, the margin's included
    turn: int = 0
    before: tuple[int, ...] = ()  # the neighbors of earlier turns
    open_area: float = 0.0  # in images, that of `before` left out


def surface_of(rec: Reconstruction, median_depth: float) -> Surface:
    """The dense cloud, or the sparse points, as cells of an eighth of the median depth."""
    points = (rec.points.xyz if rec.cloud is None else rec.cloud.xyz).double()
    edge = median_depth / _CELLS
    cells = (torch.unique((points / edge).floor().long(), dim=0).double() + 0.5) * edge
    fx, fy = rec.cameras.K[:, [0, 1], [0, 1]].double().mean(0).tolist()
    image = rec.cameras.width / fx * rec.cameras.height / fy * median_depth**2
    nearest, _ = KDTree(rec.cameras.centers.double().numpy()).query(cells.numpy())
    away = torch.from_numpy(nearest).clamp(min=median_depth)
    return Surface(cells, edge**2 / image * (median_depth / away).square(), edge)


def plan_blocks(surface: Surface, median_depth: float, settings: BlockSettings) -> tuple[PlannedBlock, ...]:
    """As few blocks as hold at most the settings' area each, alike in area; one where `largest` is 0."""
    total = float(surface.area.sum())
    count = math.ceil(total / settings.largest) if settings.largest else 1
    plane = plane_of(surface.xyz)
    uv = plane.coordinates(surface.xyz)
    windows = _cut(Window(plane), uv, surface.area, count)
    return _in_turns(windows, settings.margin * median_depth, uv, surface.area)


def _in_turns(
    windows: Sequence[Window], margin: float, uv: Float[Tensor, "n 2"], area: Float[Tensor, " n"]
) -> tuple[PlannedBlock, ...]:
    """The blocks of these windows, each in the first turn that no neighbor has."""
    blocks: list[PlannedBlock] = []
    for window in windows:
        wide = window.widened(margin)
        neighbors = [k for k, other in enumerate(blocks) if wide.meets(other.window.widened(margin))]
        taken = {blocks[k].turn for k in neighbors}
        turn = next(k for k in range(len(windows)) if k not in taken)
        seen = wide.holds_coordinates(uv)
        blocks.append(PlannedBlock(window, margin, float(area[seen].sum()), turn))
    done = []
    for k, block in enumerate(blocks):
        wide = block.window.widened(margin)
        before = tuple(
            j for j, other in enumerate(blocks) if other.turn < block.turn and wide.meets(other.window) and j != k
        )
        left = wide.holds_coordinates(uv)
        for j in before:
            left = left & ~blocks[j].window.holds_coordinates(uv)
        done.append(replace(block, before=before, open_area=float(area[left].sum())))
    return tuple(done)


def _cut(window: Window, uv: Float[Tensor, "n 2"], area: Float[Tensor, " n"], count: int) -> list[Window]:
    """The window in `count` parts of equal area, always cut across the longer side of what it holds."""
    inside = window.holds_coordinates(uv)
    if count == 1 or int(inside.sum()) < 2:
        return [window]
    uv, area = uv[inside], area[inside]
    axis = int((uv.amax(0) - uv.amin(0)).argmax())
    first = count // 2
    order = uv[:, axis].argsort()
    shares = area[order].cumsum(0) / area.sum()
    place = int(torch.searchsorted(shares, first / count).clamp(max=len(order) - 2))
    at = float(uv[order[place : place + 2], axis].mean())
    before, behind = window.halves(axis, at)
    return _cut(before, uv, area, first) + _cut(behind, uv, area, count - first)
