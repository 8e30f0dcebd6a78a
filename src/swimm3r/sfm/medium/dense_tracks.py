"""Dense tracks: the pixels of many depth maps that show the same piece of surface.

A pixel's point is looked up in the other frames; it belongs to the same track where that frame's depth map agrees (|z_j
- z| <= tolerance * z) and the colors do not contradict. Every pixel is in at most one track. The position of a track
averages the positions its depth maps give, and the ray depths of its observations are the distances from the camera
centers to that one position: errors of single depth maps do not pass for differences in distance.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from swimm3r.cameras import Cameras, project_visible, ray_depth_from_z, unproject
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.medium.settings import TrackSettings

_ROWS = 1_000_000  # points whose cubes are found at once
_MOST_ASKED = 96  # frames that are asked whether they see a frame's surface


@dataclass(frozen=True)
class DenseTracks:
    """n surface points and their o observations; observations of one track stand together."""

    xyz: Float[Tensor, "n 3"]  # world
    track: Int[Tensor, " o"]  # index into xyz
    frame: Int[Tensor, " o"]  # index into Reconstruction.names
    pixel: Int[Tensor, " o"]  # row-major index in the prepared frame
    ray_depth: Float[Tensor, " o"]  # from that frame's camera center to xyz
    confidence: Float[Tensor, " o"]  # of that frame's depth map


def fuse_depth(
    rec: Reconstruction, frames: Frames, settings: TrackSettings, progress: Progress = silent
) -> DenseTracks:
    """The dense tracks of the frames that have a depth map; at most about `settings.max_tracks`.

    Images and depth maps pass through the bounded caches of `frames` and `rec`; held are one bit per pixel and frame
    and the tracks found so far.
    """
    usable = [i for i, name in enumerate(rec.names) if name in rec.depth]
    stride = _seed_stride(rec, usable, settings.max_tracks)
    return _joined(list(_by_frame(rec, frames, usable, stride, settings, progress)))


def fuse_in_batches(
    rec: Reconstruction, frames: Frames, settings: TrackSettings, times: float, progress: Progress = silent
) -> Iterator[DenseTracks]:
    """About `times` as many tracks as `fuse_depth` finds at most, in batches of about `settings.max_tracks` or less."""
    usable = [i for i, name in enumerate(rec.names) if name in rec.depth]
    stride = _seed_stride(rec, usable, times * settings.max_tracks)
    batch: list[DenseTracks] = []
    for piece in _by_frame(rec, frames, usable, stride, settings, progress):
        batch.append(piece)
        if sum(len(held.xyz) for held in batch) >= settings.max_tracks / 2:
            yield _joined(batch)
            batch = []
    if batch:
        yield _joined(batch)


def _joined(pieces: list[DenseTracks]) -> DenseTracks:
    """The tracks of all pieces, numbered on."""
    if not pieces:
        none = torch.zeros(0)
        return DenseTracks(none.reshape(0, 3), none.long(), none.long(), none.long(), none, none)
    first = torch.tensor([0, *(len(piece.xyz) for piece in pieces[:-1])]).cumsum(0).tolist()
    pieces = [replace(piece, track=piece.track + count) for piece, count in zip(pieces, first, strict=True)]
    return DenseTracks(*(torch.cat(parts) for parts in zip(*(vars(p).values() for p in pieces), strict=True)))


def count_tracks(rec: Reconstruction, frames: Frames, settings: TrackSettings, progress: Progress = silent) -> int:
    """Number of dense tracks in all, where every pixel of known depth may start one; none is stored."""
    usable = [i for i, name in enumerate(rec.names) if name in rec.depth]
    return sum(len(piece.xyz) for piece in _by_frame(rec, frames, usable, 1, settings, progress))


def _by_frame(
    rec: Reconstruction, frames: Frames, usable: list[int], stride: int, settings: TrackSettings, progress: Progress
) -> Iterator[DenseTracks]:
    """The tracks that start in each frame, numbered from 0 in each."""
    surfaces = Surfaces(rec, usable)
    free = _FreePixels(usable, rec.cameras.height * rec.cameras.width)
    for done, i in enumerate(usable):
        progress("fusing depth", done, len(usable))
        neighbors = _neighbors(*surfaces.overlap(i), settings)
        yield _tracks_from(i, neighbors, rec, frames, free, stride, settings)
    progress("fusing depth", len(usable), len(usable))


class Surfaces:
    """The surface that each frame's depth map shows, on a grid of 12 x 16 pixels, and frames that show parts of it.

    Only the frames whose own surfaces lie near are asked, at most `_MOST_ASKED`, so that a long dive costs no more per
    frame than a short one.
    """

    def __init__(self, rec: Reconstruction, usable: list[int]) -> None:
        self.cameras = rec.cameras
        self._points: dict[int, Tensor] = {}
        rows = torch.linspace(0, rec.cameras.height - 1, 12).long()
        columns = torch.linspace(0, rec.cameras.width - 1, 16).long()
        grid = torch.stack(torch.meshgrid(columns + 0.5, rows + 0.5, indexing="xy"), -1).reshape(1, -1, 2).double()
        for i in usable:
            z = rec.depth[rec.names[i]].z_depth[rows][:, columns].reshape(-1).double()
            if (z > 0).any():
                self._points[i] = unproject(rec.cameras[i], grid[:, z > 0], z[None, z > 0])[0].float()
        self._frames = np.array(list(self._points), dtype=np.int64)
        middles = [points.median(0).values for points in self._points.values()]
        self._middle = torch.stack(middles).numpy() if middles else np.zeros((0, 3))
        self._reach = np.array(
            [float((p - m).norm(dim=-1).max()) for p, m in zip(self._points.values(), middles, strict=True)]
        )
        self._tree = KDTree(self._middle) if middles else None
        self._row = {int(i): row for row, i in enumerate(self._frames)}

    def overlap(self, i: int) -> tuple[Int[Tensor, " k"], Float[Tensor, " k"]]:
        """Other frames, and the share of frame i's surface that lies inside their images, occlusion aside."""
        if i not in self._points or self._tree is None:
            return torch.zeros(0, dtype=torch.long), torch.zeros(0)
        row = self._row[i]
        count = min(len(self._frames), _MOST_ASKED + 1)
        distance, near = (np.atleast_1d(a) for a in self._tree.query(self._middle[row], k=count))
        near = near[distance <= self._reach[row] + self._reach[near]]
        others = torch.from_numpy(np.sort(self._frames[near[near != row]]))
        if not len(others):
            return others, torch.zeros(0)
        points = self._points[i].double()
        _, _, visible = project_visible(self.cameras[others], points.expand(len(others), -1, -1))
        return others, visible.double().mean(-1).float()


class _FreePixels:
    """One bit per pixel and frame: not yet in a track."""

    def __init__(self, usable: list[int], pixels: int) -> None:
        self._bits = {i: np.full(-(-pixels // 8), 255, np.uint8) for i in usable}

    def among(self, i: int, pixel: Int[Tensor, " n"]) -> Bool[Tensor, " n"]:
        """The mask of those of these pixels of frame i that are free."""
        at = pixel.numpy()
        return torch.from_numpy((self._bits[i][at >> 3] >> (at & 7).astype(np.uint8)) & 1 == 1)

    def take(self, i: int, pixel: Int[Tensor, " n"]) -> None:
        """Strike these pixels off."""
        at = pixel.numpy()
        np.bitwise_and.at(self._bits[i], at >> 3, ~(np.uint8(1) << (at & 7).astype(np.uint8)))


def _neighbors(frames: Int[Tensor, " k"], share: Float[Tensor, " k"], settings: TrackSettings) -> list[int]:
    """Other frames that see enough of the surface of a frame: half the best, half evenly from the rest.

    The rest look from farther away or closer: observations that tell most about the water.
    """
    best_first = torch.argsort(share, descending=True, stable=True)
    order = frames[best_first[share[best_first] > settings.min_overlap]].tolist()
    best, rest = order[: settings.max_views // 2], order[settings.max_views // 2 :]
    step = max(1, -(-len(rest) // (settings.max_views - len(best)))) if rest else 1
    return best + rest[::step]


def _seed_stride(rec: Reconstruction, usable: list[int], most: float) -> int:
    """Grid step of the pixels that start tracks, so that tracks and memory stay bounded."""
    probes = usable[:: max(1, len(usable) // 8)]
    if not probes:
        return 1
    known = sum(int((rec.depth[rec.names[i]].z_depth > 0).sum()) for i in probes) / len(probes) * len(usable)
    return max(1, round((known / most) ** 0.5))


def _tracks_from(
    i: int,
    neighbors: list[int],
    rec: Reconstruction,
    frames: Frames,
    free: _FreePixels,
    stride: int,
    settings: TrackSettings,
) -> DenseTracks:
    """The tracks that start at the free pixels of frame i; what they take is struck off `free`."""
    cameras, names = rec.cameras, rec.names
    depth = rec.depth[names[i]]
    z_map = depth.z_depth.reshape(-1)
    lattice = torch.zeros(cameras.height, cameras.width, dtype=torch.bool)
    lattice[stride // 2 :: stride, stride // 2 :: stride] = True
    usable = frames.mask(frames.index(names[i])).reshape(-1)
    seeds = torch.nonzero(lattice.reshape(-1) & (z_map > 0) & usable)[:, 0]
    seeds = seeds[free.among(i, seeds)]
    free.take(i, seeds)
    start = _world_points(cameras[i], seeds, z_map[seeds])
    color = frames.colors(frames.index(names[i]), seeds)
    confidence = depth.confidence.reshape(-1)[seeds]
    weight = confidence.double().clamp(min=0.01)
    total, position = weight.clone(), start * weight[:, None]
    observations = [(torch.arange(len(seeds)), torch.full_like(seeds, i), seeds, confidence)]
    for j in neighbors if len(seeds) else []:
        uv, z, visible = (values[0] for values in project_visible(cameras[j], start[None]))
        candidates = torch.nonzero(visible)[:, 0]
        pixel = uv[candidates, 1].long() * cameras.width + uv[candidates, 0].long()
        other = rec.depth[names[j]]
        z_other = other.z_depth.reshape(-1)[pixel].double()
        index = frames.index(names[j])
        change = (frames.colors(index, pixel) - color[candidates]).abs().amax(-1)
        agrees = (z_other > 0) & ((z_other / z[candidates] - 1).abs() <= settings.tolerance)
        agrees &= frames.mask(index).reshape(-1)[pixel] & free.among(j, pixel) & (change < settings.max_color_change)
        candidates, pixel, z_other = candidates[agrees], pixel[agrees], z_other[agrees]
        alone = torch.from_numpy(np.unique(pixel.numpy(), return_index=True)[1])  # the first of two keeps the pixel
        alone = alone.sort().values
        candidates, pixel, z_other = candidates[alone], pixel[alone], z_other[alone]
        free.take(j, pixel)
        center = cameras.centers[j]
        seen = center + (start[candidates] - center) * (z_other / z[candidates])[:, None]
        trust = other.confidence.reshape(-1)[pixel]
        position.index_add_(0, candidates, seen * trust.double().clamp(min=0.01)[:, None])
        total.index_add_(0, candidates, trust.double().clamp(min=0.01))
        observations.append((candidates, torch.full_like(pixel, j), pixel, trust))
    track, frame, pixel, confidence = (torch.cat(part) for part in zip(*observations, strict=True))
    order = torch.argsort(track, stable=True)
    xyz, track, frame = position / total[:, None], track[order], frame[order]
    ray_depth = torch.linalg.vector_norm(xyz[track] - cameras.centers[frame], dim=-1)
    return DenseTracks(xyz.float(), track, frame, pixel[order], ray_depth.float(), confidence[order])


def _world_points(camera: Cameras, pixel: Int[Tensor, " n"], z_depth: Float[Tensor, " n"]) -> Float[Tensor, "n 3"]:
    """World points of the centers of row-major pixels, float64."""
    uv = torch.stack([pixel % camera.width + 0.5, pixel // camera.width + 0.5], -1).double()
    return unproject(camera, uv[None], z_depth.double()[None])[0]


def ray_depth_map(z_depth: Float[Tensor, "h w"], rays: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
    """Ray depth of a depth map, 0 where nothing is known or the lens model has no ray."""
    return torch.nan_to_num(ray_depth_from_z(z_depth, rays), nan=0.0)


def cubes(xyz: Float[Tensor, "n 3"], size: Float[Tensor, "#n"]) -> tuple[Int[Tensor, " n"], Int[Tensor, " k"]]:
    """Cube of the world's grid (edge `size`, may differ per point) of each point; number of points per cube.

    Cubes are told apart by a 64-bit mix of their indices: two of a million collide with a chance of 3e-8.
    """
    mixed = torch.empty(len(xyz), dtype=torch.long)
    for rows in torch.arange(len(xyz)).split(_ROWS):
        edge = size.double() if len(size) == 1 else size[rows].double()
        cell = torch.floor(xyz[rows].double() / edge[:, None]).long()
        key = cell @ torch.tensor([6364136223846793005, 3935559000370003845, 2862933555777941757])
        mixed[rows] = key * 2685821657736338717 ^ (key >> 29) ^ (edge.log2() * 1024).long()
    _, which, count = torch.unique(mixed, return_inverse=True, return_counts=True)
    return which, count
