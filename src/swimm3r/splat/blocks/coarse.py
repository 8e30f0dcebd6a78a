"""A block seen from afar: about an eighth of its primitives, each in place of its neighbors, and the block's box.

Of the primitives in a voxel the one that covers most remains, with the mean color of all, grown to the area that they
covered together. It is used where voxels are no larger than pixels.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import softplus

from swimm3r.splat.primitives.beta import BetaPrimitives, inverse_softplus, kernel_exponent, select
from swimm3r.splat.projection.conditioning import factor
from swimm3r.splat.projection.pixel_filter import smoothed
from swimm3r.splat.settings import RenderSettings

_TIMES = 8.0  # fewer primitives, about
_GROWTH = 3.0  # of one primitive's size, at most
_BISECTIONS = 16
_FAINT = 1e-6


@dataclass(frozen=True)
class CoarseBlock:
    """The few primitives, and the edge of the voxels that they stand for."""

    primitives: BetaPrimitives
    spacing: float


def coarse_of(p: BetaPrimitives) -> CoarseBlock:
    """The few primitives that stand for a block's; a block of less than two has none."""
    if len(p.xyz) < 2:
        return CoarseBlock(select(p, torch.zeros(0, dtype=torch.int64)), 0.0)
    voxel, edge = _voxels(p.xyz, max(1, round(len(p.xyz) / _TIMES)))
    size = softplus(p.scale[:, :3]).double()
    area = size.square().sum(-1)  # of the faces, up to a factor
    weight = torch.sigmoid(p.opacity).double() * area + _FAINT * float(area.mean())
    groups = int(voxel.max()) + 1
    total = torch.zeros(groups, dtype=torch.float64).index_add_(0, voxel, weight)
    rgb = torch.zeros(groups, 3, dtype=torch.float64).index_add_(0, voxel, weight[:, None] * p.rgb)
    order = torch.argsort(weight, descending=True, stable=True)
    order = order[torch.argsort(voxel[order], stable=True)]
    count = torch.bincount(voxel)
    first = order[count.cumsum(0) - count]
    few = select(p, first)
    growth = (total / weight[first]).sqrt().clamp(max=_GROWTH)
    scale = few.scale.clone()
    scale[:, :3] = inverse_softplus(size[first] * growth[:, None]).to(scale)
    few = few._replace(rgb=(rgb / total[:, None]).to(p.rgb), scale=scale)
    return CoarseBlock(few, edge)


def box_of(p: BetaPrimitives, settings: RenderSettings) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Corners of the box that holds all primitives of a static map, from wherever they are seen.

    A Beta primitive ends at its ellipsoid, and its center moves with the direction by G x at most.
    """
    L = factor(p, settings.rotation)
    V = L @ L.mT
    G = torch.linalg.solve(V[:, 3:, 3:], V[:, :3, 3:].mT).mT
    reach = 1 + p.query_mean.norm(dim=-1)
    V11 = smoothed(V[:, :3, :3], kernel_exponent(p), p.footprint, settings)
    half = V11[:, [0, 1, 2], [0, 1, 2]].sqrt() + G.norm(dim=-1) * reach[:, None]
    return (p.xyz - half).amin(0), (p.xyz + half).amax(0)


def _voxels(xyz: Float[Tensor, "n 3"], wanted: int) -> tuple[Int[Tensor, " n"], float]:
    """The number of each point's voxel, and the edge at which there are about as many as wanted."""
    high = float((xyz.amax(0) - xyz.amin(0)).max().clamp(min=1e-6))
    low = 1e-5 * high
    for _ in range(_BISECTIONS):
        edge = (low * high) ** 0.5
        voxel = torch.unique((xyz.double() / edge).floor().long(), dim=0, return_inverse=True)[1]
        found = int(voxel.max()) + 1
        if abs(found - wanted) <= 0.05 * wanted:
            break
        low, high = (edge, high) if found > wanted else (low, edge)
    return voxel, edge
