"""The points that a map's primitives of any kind start from: the cloud and its backdrop, thinned."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from swimm3r.cameras import project_visible
from swimm3r.errors import InputError
from swimm3r.scene.reconstruction import DenseCloud, Reconstruction
from swimm3r.splat.gaussian_settings import GaussianInitialSettings
from swimm3r.splat.primitives.thinning import Shown, covering_sample, voxel_sample
from swimm3r.splat.settings import InitialSettings

_COVERED = 256  # frames, the most that the first points cover
_ON_SURFACE = 0.05  # of the depth of the surface
_CANDIDATES = 6  # times as many points as are wanted, among which those are chosen that cover the frames


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
        chosen = _thinned(points, settings.primitives, rec)
        return points[chosen], rec.points.rgb[chosen].float()
    none = DenseCloud(*(torch.zeros(0, 3),) * 3)
    backdrop = rec.backdrop if rec.backdrop is not None and settings.backdrop else none
    n, most = len(rec.cloud.xyz), round(settings.backdrop * settings.primitives)
    points = torch.cat([rec.cloud.xyz, backdrop.xyz]).double()
    both = _thinned(points, settings.primitives, rec)
    measured, behind = both[both < n], both[both >= n]
    if len(behind) > most:
        behind = n + _thinned(points[n:], most, rec)
        measured = _thinned(points[:n], settings.primitives - len(behind), rec)
    colors = (getattr(cloud, settings.colors) for cloud in (rec.cloud, backdrop))
    chosen = torch.cat([measured, behind])
    return points[chosen], torch.cat([*colors])[chosen].float().clamp(max=1)  # as `weights.gamut` asks


def _thinned(points: Float[Tensor, "p 3"], target: int, rec: Reconstruction) -> Int[Tensor, " n"]:
    """About `target` of the points, each for as many pixels of the frames that show it.

    A grid of voxels leaves more of them on ground that many frames see, whose points fill a shell around the surface,
    and too few on ground near by or seen once. Points that no frame shows are thinned to voxels, by as much.
    """
    if target == 0 or len(points) <= target:
        return torch.arange(min(target, len(points)))
    candidates = voxel_sample(points, _CANDIDATES * target)
    shown = _shown(points[candidates], rec)
    seen = torch.zeros(len(candidates), dtype=torch.bool)
    for image in shown:
        seen[torch.from_numpy(image.index).long()] = True
    hidden = candidates[~seen]
    others = hidden[voxel_sample(points[hidden], round(target * len(hidden) / len(candidates)))]
    covering = candidates[covering_sample(len(candidates), target - len(others), shown)]
    return torch.cat([covering, others])


def _shown(xyz: Float[Tensor, "n 3"], rec: Reconstruction) -> list[Shown]:
    """The points that frames show: in their images and, where depth was measured, on the surface."""
    shown = []
    for i in _evenly(rec, _COVERED):
        pixels, inside, depth = _in_frame(xyz, rec, i)
        index = (inside & ((depth - 1).abs() < _ON_SURFACE)).nonzero()[:, 0]
        shown.append(Shown(index.int().numpy(), pixels[index].float().numpy()))
    return shown


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
    seen: Bool[Tensor, " n"]


def _sights(xyz: Float[Tensor, "n 3"], rec: Reconstruction, max_views: int) -> Iterator[_Sight]:
    """Up to `max_views` frames, evenly taken."""
    for i in _evenly(rec, max_views):
        toward = xyz - rec.cameras[i].centers[0].to(xyz)
        distance = toward.norm(dim=-1, keepdim=True).clamp(min=torch.finfo(xyz.dtype).tiny)
        _, inside, depth = _in_frame(xyz, rec, i)
        yield _Sight(toward / distance, inside & (depth < 1 + _ON_SURFACE))


def _evenly(rec: Reconstruction, most: int) -> list[int]:
    return torch.linspace(0, len(rec.names) - 1, min(most, len(rec.names))).round().long().tolist()


def _in_frame(
    xyz: Float[Tensor, "n 3"], rec: Reconstruction, i: int
) -> tuple[Float[Tensor, "n 2"], Bool[Tensor, " n"], Float[Tensor, " n"]]:
    """Pixels of points, those that are in the image, and their depth as a share of the surface's, 1 where unknown."""
    camera, name = rec.cameras[i], rec.names[i]
    pixels, z, inside = (values[0] for values in project_visible(camera, xyz[None]))
    depth = torch.ones_like(z)
    if name in rec.depth:
        z_depth = rec.depth[name].z_depth
        column, row = torch.where(inside[:, None], pixels, 0.0).long().unbind(-1)
        surface = z_depth[row, column].to(z)
        depth = torch.where(surface == 0, 1.0, z / surface)
    return pixels, inside, depth
