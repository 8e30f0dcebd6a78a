"""The points that a map's primitives of any kind start from: the cloud and its backdrop, thinned."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from swimm3r.cameras import Cameras, project_visible
from swimm3r.errors import InputError
from swimm3r.scene.reconstruction import DenseCloud, Reconstruction
from swimm3r.splat.gaussian_settings import GaussianInitialSettings
from swimm3r.splat.settings import InitialSettings

_VIEWS = 64  # frames, the most that are asked for the pixels that show a point
_RANGE = 3.0  # times the median of the points' spacing and its inverse, between which it stays


@dataclass(frozen=True)
class StartingPoints:
    """Initial positions of primitives of any kind."""

    xyz: Float[Tensor, "n 3"]  # float64
    rgb: Float[Tensor, "n 3"]
    spacing: Float[Tensor, " n"]  # root mean square distance to the 3 nearest neighbors, float64


def starting_points(rec: Reconstruction, settings: InitialSettings | GaussianInitialSettings) -> StartingPoints:
    """The cloud and its backdrop, thinned to as many pixels per point. Raises InputError for fewer than 4 points."""
    xyz, rgb = _sampled(rec, settings)
    if len(xyz) < 4:
        raise InputError(
            f"a map starts from at least 4 points, and the reconstruction has {len(xyz)} in different places",
            cause="hardly any depth was found, or the model came without points",
            hint="more frames of the same place, or another reconstruction",
        )
    distances, _ = KDTree(xyz.numpy()).query(xyz.numpy(), k=4)
    spacing = torch.from_numpy(distances[:, 1:]).square().mean(-1).sqrt()
    # doubled points would be points of no size
    return StartingPoints(xyz, rgb, spacing.clamp(min=1e-3 * float(spacing.median())))


def _sampled(
    rec: Reconstruction, settings: InitialSettings | GaussianInitialSettings
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Positions, float64, and colors."""
    if rec.cloud is None:
        points = rec.points.xyz.double()
        chosen = voxel_sample(points, settings.primitives, pixel_spacing(points, rec))
        return points[chosen], rec.points.rgb[chosen].float()
    none = DenseCloud(*(torch.zeros(0, 3),) * 3)
    backdrop = rec.backdrop if rec.backdrop is not None and settings.backdrop else none
    n, most = len(rec.cloud.xyz), round(settings.backdrop * settings.primitives)
    points = torch.cat([rec.cloud.xyz, backdrop.xyz]).double()
    spacing = pixel_spacing(points, rec)
    both = voxel_sample(points, settings.primitives, spacing)
    measured, behind = both[both < n], both[both >= n]
    if len(behind) > most:
        behind = n + voxel_sample(points[n:], most, spacing[n:])
        measured = voxel_sample(points[:n], settings.primitives - len(behind), spacing[:n])
    colors = (getattr(cloud, settings.colors) for cloud in (rec.cloud, backdrop))
    chosen = torch.cat([measured, behind])
    return points[chosen], torch.cat([*colors])[chosen].float()


def voxel_sample(
    points: Float[Tensor, "p 3"], target: int, spacing: Float[Tensor, " p"] | None = None
) -> Int[Tensor, " n"]:
    """One point per occupied voxel, the nearest to its voxel's mean; the edge is bisected until about `target` remain.

    Edges are as `spacing` to each other, in steps of 2^(1/4) with a grid of its own each; alike where it is None. All
    points where there are no more than `target`, none for 0; within 1 % of it where the points allow, else more.
    """
    if target == 0:
        return torch.zeros(0, dtype=torch.int64)
    if len(points) <= target:
        return torch.arange(len(points))
    extent = float((points.amax(0) - points.amin(0)).max())
    low, high = extent * 1e-6, extent
    step = torch.zeros(len(points)) if spacing is None else (4 * torch.log2(spacing / spacing.min())).round()
    for _ in range(40):
        edge = (low * high) ** 0.5
        voxel = _voxels(points, edge, step)
        found = int(voxel.max()) + 1
        if abs(found - target) <= 0.01 * target:
            break
        low, high = (edge, high) if found > target else (low, edge)
    else:
        voxel = _voxels(points, low, step)
    count = torch.bincount(voxel)
    mean = torch.zeros(len(count), 3, dtype=points.dtype).index_add_(0, voxel, points) / count[:, None]
    distance = (points - mean[voxel]).square().sum(-1)
    order = torch.argsort(distance, stable=True)
    nearest_first = order[torch.argsort(voxel[order], stable=True)]
    return nearest_first[count.cumsum(0) - count]


def _voxels(points: Float[Tensor, "p 3"], edge: float, step: Float[Tensor, " p"]) -> Int[Tensor, " p"]:
    """The number of each point's voxel, counted over the occupied ones; the edge is that of step 0."""
    edges = edge * 2 ** (step / 4)
    cell = ((points - points.amin(0)) / edges[:, None]).long()
    size = cell.amax(0) + 1
    place = (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]
    return torch.unique(place * (int(step.max()) + 1) + step.long(), return_inverse=True)[1]


def pixel_spacing(xyz: Float[Tensor, "n 3"], rec: Reconstruction) -> Float[Tensor, " n"]:
    """Spacing at which points stand for as many pixels of the frames that see them everywhere, up to a common factor.

        spacing = (mean over the frames that see the point of 1 / d^2)^(-1/2)

    as an area at the distance d fills pixels as 1 / d^2; float64, within a factor of 3 of its median, the largest where
    no frame sees the point. How many do plays no part: ground that a diver passes once is to look like any other.
    """
    total, seen_by = torch.zeros(2, len(xyz), dtype=torch.float64)
    for sight in _sights(xyz, rec, _VIEWS):
        total += sight.seen / sight.distance**2
        seen_by += sight.seen
    spacing = (seen_by / total.clamp(min=torch.finfo(total.dtype).tiny)) ** 0.5
    seen = seen_by > 0
    middle = spacing[seen].median() if bool(seen.any()) else torch.ones(()).double()
    return torch.where(seen, spacing, middle * _RANGE).clamp(middle / _RANGE, middle * _RANGE)


def mean_directions(xyz: Float[Tensor, "n 3"], rec: Reconstruction, max_views: int) -> Float[Tensor, "n 3"]:
    """Mean of the unit directions, camera -> point, over the frames that see each point; over all where none does.

    A frame sees a point that falls into its image, not behind its depth map.
    """
    total, everywhere, seen_by = torch.zeros_like(xyz), torch.zeros_like(xyz), xyz.new_zeros(len(xyz), 1)
    for sight in _sights(xyz, rec, max_views):
        total += torch.where(sight.seen[:, None], sight.direction, 0.0)
        everywhere += sight.direction
        seen_by += sight.seen[:, None]
    return torch.where(seen_by > 0, total / seen_by.clamp(min=1), everywhere / min(max_views, len(rec.names)))


@dataclass(frozen=True)
class _Sight:
    """Points from the place of one frame."""

    direction: Float[Tensor, "n 3"]  # of unit length, camera -> point
    distance: Float[Tensor, " n"]
    seen: Bool[Tensor, " n"]


def _sights(xyz: Float[Tensor, "n 3"], rec: Reconstruction, max_views: int) -> Iterator[_Sight]:
    """Up to `max_views` frames, evenly taken."""
    for i in torch.linspace(0, len(rec.names) - 1, min(max_views, len(rec.names))).round().long().tolist():
        camera = rec.cameras[i]
        toward = xyz - camera.centers[0].to(xyz)
        distance = toward.norm(dim=-1).clamp(min=torch.finfo(xyz.dtype).tiny)
        yield _Sight(toward / distance[:, None], distance, _sees(rec, camera, rec.names[i], xyz))


def _sees(rec: Reconstruction, camera: Cameras, name: str, xyz: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
    pixels, z, inside = (values[0] for values in project_visible(camera, xyz[None]))
    if name in rec.depth:
        z_depth = rec.depth[name].z_depth
        column, row = torch.where(inside[:, None], pixels, 0.0).long().unbind(-1)
        surface = z_depth[row, column].to(z)
        inside &= (surface == 0) | (z < 1.05 * surface)
    return inside
