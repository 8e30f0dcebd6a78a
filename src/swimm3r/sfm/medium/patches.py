"""Patches of surface, as frames show them: what the decay of color with distance is read from.

A patch is a cube some pixels wide as seen from afar, and the dense tracks in it. Its color in a frame is the mean over
all of its tracks, those included that the frame itself did not add to: where a frame looks from afar, one of its pixels
shows several of them. The mean over a frame's own observations alone would be that of other parts of the patch in every
frame, and contrast within the patch would pass for light and water (docs/experiments/medium.md). A single pixel would
not do either: it shows more surface from afar, and the contrast that it loses would pass for attenuation.

Where the borders of patches happen to lie moves what is read from them. So there are several grids of cubes, shifted
against each other: each track is in a patch of every grid.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from swimm3r.cameras import project_visible
from swimm3r.imaging.clipped import clipped
from swimm3r.imaging.undistortion import frame_directions
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.sfm.medium.dense_tracks import DenseTracks, cubes
from swimm3r.sfm.medium.settings import SeathruSettings

_WIDEST = 1 / 16  # of the longer side of an image, an edge of a patch
_STEP = torch.tensor([1.0, 2.0, 3.0])  # from one grid to the next along the axes, in edges over the number of grids


@dataclass(frozen=True)
class Patches:
    """p patches of the n dense tracks in g grids; the tracks of one patch stand together in `members`."""

    tracks: DenseTracks
    of_track: Int[Tensor, "g n"]
    size: Float[Tensor, " p"]  # edge of the cube
    middle: Float[Tensor, "p 3"]  # mean of the patch's tracks, world
    members: Int[Tensor, " gn"]  # tracks, by patch
    first: Int[Tensor, " p"]  # of each patch, in `members`
    count: Int[Tensor, " p"]  # tracks of each patch

    def tracks_of(self, patch: Int[Tensor, " k"]) -> Int[Tensor, " t"]:
        """The tracks of some patches, one patch after another."""
        count = self.count[patch]
        start = self.first[patch] - (count.cumsum(0) - count)
        return self.members[torch.repeat_interleave(start, count) + torch.arange(int(count.sum()))].long()


@dataclass(frozen=True)
class SeenPatches:
    """Patches that one frame shows."""

    I: Float[Tensor, "k 3"]  # mean colors, as stored
    ray_depth: Float[Tensor, " k"]
    patch: Int[Tensor, " k"]
    direction: Float[Tensor, "k 3"]  # unit, camera axes


def group_tracks(rec: Reconstruction, tracks: DenseTracks, settings: SeathruSettings) -> Patches:
    """Cubes about `patch_pixels` wide for the farthest observation of a track, in steps of powers of two."""
    n, grids = len(tracks.xyz), settings.patch_grids
    far = torch.zeros(n).scatter_reduce_(0, tracks.track, tracks.ray_depth, "amax")
    focal = float(rec.cameras.K[:, 0, 0].median())
    pixels = min(settings.patch_pixels, _WIDEST * max(rec.cameras.width, rec.cameras.height))
    size = 2.0 ** torch.round(torch.log2((pixels * far / focal).clamp(min=1e-12)))
    of_track, members, counts, middles, edges, before = [], [], [], [], [], 0
    for k in range(grids):
        of_grid, count = cubes(tracks.xyz + (k * _STEP / grids).frac() * size[:, None], size)
        total = torch.zeros(len(count), 3, dtype=torch.float64).index_add_(0, of_grid, tracks.xyz.double())
        middles.append((total / count[:, None]).float())
        edges.append(torch.zeros(len(count)).scatter_(0, of_grid, size))
        of_track.append((of_grid + before).int())  # long dives have tens of millions of tracks
        members.append(torch.argsort(of_grid, stable=True).int())
        counts.append(count)
        before += len(count)
    count = torch.cat(counts)
    first = count.cumsum(0) - count
    return Patches(
        tracks, torch.stack(of_track), torch.cat(edges), torch.cat(middles), torch.cat(members), first, count
    )


def patches_seen(
    rec: Reconstruction,
    frames: Frames,
    i: int,
    own: Int[Tensor, " s"],
    patches: Patches,
    settings: SeathruSettings,
) -> SeenPatches:
    """The patches that frame i of the reconstruction shows as a whole and without a clipped pixel.

    Asked are those that enough of the frame's own observations (`own`, rows of the tracks) lie in. A track is seen
    where the frame's depth map agrees with its place.
    """
    asked, observed = torch.unique(patches.of_track[:, patches.tracks.track[own]], return_counts=True)
    asked = asked[observed >= settings.patch_observations].long()
    tracks, again = torch.unique(patches.tracks_of(asked), return_inverse=True)  # one is in patches of several grids
    camera, index, xyz = rec.cameras[i], frames.index(rec.names[i]), patches.tracks.xyz[tracks]
    uv, z, visible = (values[0] for values in project_visible(camera, xyz.double()[None]))
    pixel = torch.where(visible, uv[:, 1].long() * camera.width + uv[:, 0].long(), 0)
    off = (rec.depth[rec.names[i]].z_depth.reshape(-1)[pixel] - z).abs()
    seen = visible & (off <= settings.tracks.tolerance * z) & frames.mask(index).reshape(-1)[pixel]
    colors, toward = frames.colors(index, pixel), frame_directions(camera).reshape(-1, 3)[pixel]
    away = torch.linalg.vector_norm(xyz - rec.cameras.centers[i].float(), dim=-1, keepdim=True)
    full = clipped(colors, settings.saturated).any(-1, keepdim=True)
    there = seen[again]
    of = torch.repeat_interleave(asked, patches.count[asked])[there]
    patch, which, count = torch.unique_consecutive(of, return_inverse=True, return_counts=True)
    of_tracks = torch.cat([colors, xyz, away, toward, full], dim=-1)[again[there]]
    means = torch.zeros(len(patch), of_tracks.shape[1]).index_add_(0, which, of_tracks) / count[:, None]
    I, middle, ray_depth, direction, overexposed = means.split([3, 3, 1, 3, 1], dim=-1)
    offset = (middle - patches.middle[patch]).norm(dim=-1) / patches.size[patch]
    whole = (count >= settings.patch_share * patches.count[patch]) & (offset < settings.patch_offset)
    whole &= overexposed[:, 0] == 0
    return SeenPatches(I[whole], ray_depth[whole, 0], patch[whole], normalize(direction[whole], dim=-1))
