"""The dense cloud of a dive: its dense tracks as points with raw and restored colors, thinned to a number by area.

`max_points` is for a surface of up to `max_points_area` images (`scene.surface`), larger ones have more in proportion,
so that a long dive has no coarser a cloud than a short one. The tracks that the water is fitted to are a fixed number;
those of the points of a large surface are found anew, closer together, and restored in batches.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from swimm3r.imaging.undistortion import frame_directions
from swimm3r.medium import (
    Medium,
    MediumFit,
    expected_colors,
    linear_from_srgb,
    remove_water,
    srgb_from_linear,
    transmittances,
)
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import DenseCloud, Reconstruction
from swimm3r.scene.surface import surface_of
from swimm3r.scene.white_balance import BRIGHTEST
from swimm3r.sfm.medium.dense_tracks import DenseTracks, cubes, fuse_in_batches
from swimm3r.sfm.medium.settings import RestoreSettings, TrackSettings

MediumOfPixels = Callable[[str, Int[Tensor, " n"], Float[Tensor, " n"]], Medium]  # frame, pixels, ray depth

MIN_TRANSMITTANCE = 0.025  # of the fitted water: what is divided by at least, and where a color is half known
_FULL, _TURNS = 0.85, 12  # share of the points wanted, and trials of a voxel size, that end the search for it
_ROWS = 1_000_000  # points averaged at once


def dense_cloud(
    rec: Reconstruction,
    frames: Frames,
    tracks: DenseTracks,
    fit: MediumFit,
    settings: RestoreSettings,
    fusion: TrackSettings,
    progress: Progress = silent,
    medium_at: MediumOfPixels | None = None,
    min_transmittance: float = MIN_TRANSMITTANCE,
) -> DenseCloud:
    """The cloud of these tracks, or of closer ones where the surface is larger than `settings.max_points_area`.

    `tracks` are what `fuse_depth` found with the settings `fusion`; the rest is handed on to `restored_points`.
    """
    times = times_as_many(rec, tracks, settings)
    if times == 1:
        cloud = restored_points(rec, frames, tracks, fit, progress, medium_at, min_transmittance)
    else:
        pieces = [
            restored_points(rec, frames, batch, fit, silent, medium_at, min_transmittance)
            for batch in fuse_in_batches(rec, frames, fusion, times, progress)
        ]
        cloud = DenseCloud(*(torch.cat(parts) for parts in zip(*(vars(p).values() for p in pieces), strict=True)))
    return thinned(cloud, round(times * settings.max_points))


def times_as_many(rec: Reconstruction, tracks: DenseTracks, settings: RestoreSettings) -> float:
    """Multiple of `settings.max_points` that the surface of these tracks gets; at least 1."""
    if not settings.max_points_area or not len(tracks.xyz):
        return 1.0
    area = surface_of(rec, float(tracks.ray_depth.median()), tracks.xyz).area.sum()
    return max(1.0, float(area) / settings.max_points_area)


def restored_points(
    rec: Reconstruction,
    frames: Frames,
    tracks: DenseTracks,
    fit: MediumFit,
    progress: Progress = silent,
    medium_at: MediumOfPixels | None = None,
    min_transmittance: float = MIN_TRANSMITTANCE,
) -> DenseCloud:
    """The tracks as points: raw and restored colors averaged over the observations.

    Restored colors are weighted by confidence and mean T_D squared, the inverse variance of an amplified color. In
    channels of which no observation kept more than `min_transmittance` they are those that the others let expect.
    `medium_at` gives each pixel its own water in the place of the dive's, in the encoding of `fit`, and Eq. 4 alone.
    `min_transmittance` bounds what is divided by (eps_inv).
    """
    n = len(tracks.xyz)
    raw, restored = torch.zeros(n, 3), torch.zeros(n, 3)
    raw_weight, restored_weight = torch.zeros(n, 1), torch.zeros(n, 3)
    order = torch.argsort(tracks.frame, stable=True)
    bounds = torch.searchsorted(tracks.frame[order], torch.arange(len(rec.names) + 1))
    for i, name in enumerate(rec.names):
        progress("restoring points", i, len(rec.names))
        mine = order[bounds[i] : bounds[i + 1]]
        if len(mine) == 0:
            continue
        I = frames.colors(frames.index(name), tracks.pixel[mine])
        light = linear_from_srgb(I) if fit.encoding == "linear" else I
        z, trust = tracks.ray_depth[mine], tracks.confidence[mine, None].clamp(min=0.01)
        if medium_at is None:
            medium = fit.at(z, frame_directions(rec.cameras[i]).reshape(-1, 3)[tracks.pixel[mine]])
        else:
            medium = medium_at(name, tracks.pixel[mine], z)
        T_D, _ = transmittances(z, medium)
        weight = trust * T_D.clamp(min=1e-3) ** 2
        raw.index_add_(0, tracks.track[mine], I * trust)
        raw_weight.index_add_(0, tracks.track[mine], trust)
        restored.index_add_(0, tracks.track[mine], remove_water(light, z, medium, min_transmittance) * weight)
        restored_weight.index_add_(0, tracks.track[mine], weight)
    progress("restoring points", len(rec.names), len(rec.names))
    J = restored / restored_weight.clamp(min=1e-12)
    if medium_at is None:
        T_D = (restored_weight / raw_weight.clamp(min=1e-12)).sqrt()
        known = T_D**2 / (T_D**2 + min_transmittance**2)
        J = J.clamp(0, BRIGHTEST)
        J = known * J + (1 - known) * expected_colors(J, known)
    if fit.encoding == "linear":
        J = srgb_from_linear(J.clamp(min=0))
    return DenseCloud(tracks.xyz, (raw / raw_weight.clamp(min=1e-12)).clamp(0, 1), J.clamp(0, BRIGHTEST))


def thinned(cloud: DenseCloud, count: int) -> DenseCloud:
    """One averaged point per voxel, with voxels just large enough to leave at most `count`, and hardly fewer.

    The number of voxels of a surface falls with the square of their size, whatever the shape of the dive.
    """
    n = len(cloud.xyz)
    if n <= count:
        return cloud
    low, high = (torch.quantile(cloud.xyz[:: max(1, n // 100_000)], q, dim=0) for q in (0.02, 0.98))
    size = float((high - low).amax()) / max(1.0, count**0.5)
    which, number = cubes(cloud.xyz, torch.tensor([size]))
    for turn in range(_TURNS):
        if _FULL * count <= len(number) <= count or (turn > _TURNS // 2 and len(number) <= count):
            break
        size *= min(10.0, max(0.1, (len(number) / (0.95 * count)) ** 0.5))
        which, number = cubes(cloud.xyz, torch.tensor([size]))
    while len(number) > count:
        size *= max(1.05, (len(number) / count) ** 0.4)
        which, number = cubes(cloud.xyz, torch.tensor([size]))

    def average(x: Tensor) -> Tensor:
        total = torch.zeros(len(number), 3, dtype=torch.float64)
        for rows in torch.arange(n).split(_ROWS):
            total.index_add_(0, which[rows], x[rows].double())
        return (total / number[:, None]).float()

    return DenseCloud(average(cloud.xyz), average(cloud.raw), average(cloud.restored))
