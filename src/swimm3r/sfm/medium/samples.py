"""The pixels from which the water is fitted: drawn from every training frame of a dive, with their ray depths.

Single pixels serve the dark envelope and the averages; the decay of color differences is read from patches of surface
(patches.py).
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from swimm3r.imaging.depth_completion import fill_z_depth
from swimm3r.imaging.filters import blur
from swimm3r.imaging.open_water import open_water_mask
from swimm3r.imaging.undistortion import frame_directions, frame_rays
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import DepthMap, Reconstruction
from swimm3r.sfm.medium.dense_tracks import DenseTracks, ray_depth_map
from swimm3r.sfm.medium.patches import SeenPatches, group_tracks, patches_seen
from swimm3r.sfm.medium.settings import SeathruSettings
from swimm3r.sfm.medium.side_by_side import in_order

_ALONE = 240  # frames whose single pixels are sampled: more of a long dive tell nothing new


@dataclass(frozen=True)
class WaterSamples:
    """Pixels of a dive with known distance, pooled over its frames."""

    I: Float[Tensor, "n 3"]  # as stored, 0..1
    ray_depth: Float[Tensor, " n"]  # > 0
    frame: Int[Tensor, " n"]  # which image: errors are shared within one
    track: Int[Tensor, " n"]  # which patch of surface; -1 for pixels on their own
    open_water: Float[Tensor, "m 3"]  # pixels beyond every surface; empty where the frames show none
    gray: bool = False  # the three channels are one (`Frames.gray`)
    direction: Float[Tensor, "n 3"] | None = None  # unit, camera axes; without, no lamp can be told from the sun
    water_direction: Float[Tensor, "m 3"] | None = None  # of the open water's pixels
    grids: int = 1  # of patches: so many patches show the same pixels


def collect_samples(
    rec: Reconstruction, frames: Frames, tracks: DenseTracks, settings: SeathruSettings, progress: Progress = silent
) -> WaterSamples:
    """Samples of every frame that has a depth map: patches of all, pixels on their own of `_ALONE` at most.

    The frames whose pixels are taken lie evenly over the dive.
    """
    patches = group_tracks(rec, tracks, settings)
    usable = [i for i, name in enumerate(rec.names) if name in rec.depth]
    alone = set(usable[:: max(1, -(-len(usable) // _ALONE))])
    per_frame = max(1, settings.max_pixels // max(1, len(alone)))
    order = torch.argsort(tracks.frame, stable=True)
    bounds = torch.searchsorted(tracks.frame[order], torch.arange(len(rec.names) + 1))

    def of_frame(i: int) -> list[WaterSamples]:
        seen = patches_seen(rec, frames, i, order[bounds[i] : bounds[i + 1]], patches, settings)
        of_patches = _of_patches(i, seen, frames.gray)
        return [_pixels_alone(rec, frames, i, per_frame, settings), of_patches] if i in alone else [of_patches]

    parts: list[WaterSamples] = []
    for done, found in enumerate(in_order(of_frame, usable)):
        progress("sampling the water", done, len(usable))
        parts += found
    progress("sampling the water", len(usable), len(usable))
    if not parts:
        none = torch.zeros(0)
        return WaterSamples(none.reshape(0, 3), none, none.long(), none.long(), none.reshape(0, 3), frames.gray)
    every = _joined(parts)
    kept = _plausible_water(every.open_water, every.I, every.ray_depth)
    assert every.water_direction is not None
    toward = every.water_direction[kept]
    return replace(every, open_water=every.open_water[kept], water_direction=toward, grids=settings.patch_grids)


def _joined(parts: list[WaterSamples]) -> WaterSamples:
    """The samples of all parts, all of which have directions."""

    def column(name: str) -> Tensor:
        return torch.cat([getattr(part, name) for part in parts])

    return WaterSamples(
        column("I"), column("ray_depth"), column("frame"), column("track"), column("open_water"),
        parts[0].gray, column("direction"), column("water_direction"),
    )  # fmt: skip


def _of_patches(i: int, seen: SeenPatches, gray: bool) -> WaterSamples:
    """The patches that frame i shows."""
    none = torch.zeros(0, 3)
    frame = torch.full_like(seen.patch, i)
    return WaterSamples(seen.I, seen.ray_depth, frame, seen.patch, none, gray, seen.direction, none)


def _pixels_alone(rec: Reconstruction, frames: Frames, i: int, count: int, settings: SeathruSettings) -> WaterSamples:
    """About `count` pixels of a frame on their own, and of open water, if it shows any."""
    index = frames.index(rec.names[i])
    image, mask = frames.image(index), frames.mask(index)
    ray_depth, sea = _ray_depth_nearby(image, rec.depth[rec.names[i]], frame_rays(rec.cameras[i]))
    pixels = torch.nonzero((ray_depth.reshape(-1) > 0) & mask.reshape(-1))[:, 0]
    pixels = pixels[:: max(1, len(pixels) // count)]
    direction = frame_directions(rec.cameras[i]).reshape(-1, 3)
    shown = torch.nonzero((sea & mask).reshape(-1))[:, 0]
    shown = shown[:: max(1, len(shown) // settings.open_water_pixels)]
    colors = image.reshape(-1, 3)
    return WaterSamples(
        colors[pixels], ray_depth.reshape(-1)[pixels], torch.full_like(pixels, i), torch.full_like(pixels, -1),
        colors[shown], frames.gray, direction[pixels], direction[shown],
    )  # fmt: skip


def _ray_depth_nearby(
    image: Float[Tensor, "h w 3"], depth: DepthMap, rays: Float[Tensor, "h w 3"]
) -> tuple[Float[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """Ray depth, filled in around known pixels and 0 elsewhere; and open water.

    Black things, which show the backscatter, rarely have texture enough for a depth of their own.
    """
    known = depth.z_depth > 0
    if not known.any():
        return torch.zeros_like(depth.z_depth), torch.zeros_like(known)
    sea = open_water_mask(image, depth.z_depth)
    filled = fill_z_depth(image, depth, sea.float())
    reach = 0.02 * max(image.shape[:2])
    near = (blur(known.float()[..., None], reach)[..., 0] > 0.1) & ~sea
    return torch.where(near, ray_depth_map(filled, rays), 0.0), sea


def _plausible_water(
    open_water: Float[Tensor, "m 3"], I: Float[Tensor, "n 3"], ray_depth: Float[Tensor, " n"]
) -> Bool[Tensor, " m"]:
    """False where darker than the dark envelope of the farthest tenth: veil grows with distance, shadow does not."""
    if len(open_water) == 0 or len(I) == 0:
        return torch.ones(len(open_water), dtype=torch.bool)
    far = ray_depth >= torch.quantile(ray_depth[:: max(1, len(ray_depth) // 100_000)], 0.9)
    envelope = torch.quantile(I[far][:100_000], 0.02, dim=0)
    return (open_water >= envelope - 0.02).all(-1)
