"""The pixels from which the water is fitted: drawn from every training frame of a dive, with their ray depths.

Pixels on their own, averaged over a few around them, serve the dark envelope and the averages; the decay of color
differences is read from patches of surface (patches.py). Black things, which show the backscatter, rarely have texture
enough for a depth of their own: kelp and its shadows have none. Pixels far from measured depth take a guessed one, and
serve the dark envelope alone.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from swimm3r.cameras import pixel_grid, project_visible, unproject
from swimm3r.imaging.depth_completion import fill_z_depth
from swimm3r.imaging.filters import blur
from swimm3r.imaging.open_water import open_water_mask
from swimm3r.imaging.undistortion import frame_directions, frame_rays
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import DepthMap, Reconstruction
from swimm3r.sfm.medium.dense_tracks import DenseTracks, Surfaces, ray_depth_map
from swimm3r.sfm.medium.patches import SeenPatches, group_tracks, patches_seen
from swimm3r.sfm.medium.settings import SeathruSettings
from swimm3r.sfm.medium.side_by_side import in_order

_ALONE = 240  # frames whose single pixels are sampled: more of a long dive tell nothing new
_QUIET = 1.5  # px, standard deviation of the window that pixels on their own are averaged over
_ASKED = 4  # other frames that are asked what they show of a surface without a measured depth


@dataclass(frozen=True)
class WaterSamples:
    """Pixels of a dive with known distance, pooled over its frames."""

    I: Float[Tensor, "n 3"]  # as stored, 0..1
    ray_depth: Float[Tensor, " n"]  # > 0
    frame: Int[Tensor, " n"]  # which image: errors are shared within one
    track: Int[Tensor, " n"]  # which patch of surface; -1 for pixels on their own
    open_water: Float[Tensor, "m 3"]  # pixels beyond every surface; empty where the frames show none
    gray: bool = False  # the three channels are one (`Frames.gray`)
    guessed: Bool[Tensor, " n"] | None = None  # of a guessed depth, for the dark envelope alone; None: all are measured
    direction: Float[Tensor, "n 3"] | None = None  # unit, camera axes; without, no lamp can be told from the sun
    water_direction: Float[Tensor, "m 3"] | None = None  # of the open water's pixels
    grids: int = 1  # of patches: so many patches show the same pixels

    @property
    def measured(self) -> Bool[Tensor, " n"]:
        """True at the pixels of measured depth, or filled in close by."""
        return torch.ones_like(self.ray_depth, dtype=torch.bool) if self.guessed is None else ~self.guessed


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
    surfaces = Surfaces(rec, usable)

    def of_frame(i: int) -> list[WaterSamples]:
        seen = patches_seen(rec, frames, i, order[bounds[i] : bounds[i + 1]], patches, settings)
        of_patches = _of_patches(i, seen, frames.gray)
        if i not in alone:
            return [of_patches]
        return [*_pixels_alone(rec, frames, i, _asked(surfaces, i, settings), per_frame, settings), of_patches]

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
        parts[0].gray, column("guessed"), column("direction"), column("water_direction"),
    )  # fmt: skip


def _of_patches(i: int, seen: SeenPatches, gray: bool) -> WaterSamples:
    """The patches that frame i shows."""
    none = torch.zeros(0, 3)
    frame = torch.full_like(seen.patch, i)
    measured = torch.zeros_like(seen.patch, dtype=torch.bool)
    return WaterSamples(seen.I, seen.ray_depth, frame, seen.patch, none, gray, measured, seen.direction, none)


def _asked(surfaces: Surfaces, i: int, settings: SeathruSettings) -> list[int]:
    """At most `_ASKED` of the frames that see much of frame i's surface, from all over the time that it is in view."""
    others, share = surfaces.overlap(i)
    others = others[share >= settings.tracks.min_overlap]
    return others[torch.linspace(0, max(0, len(others) - 1), min(_ASKED, len(others))).round().long()].tolist()


def _pixels_alone(
    rec: Reconstruction, frames: Frames, i: int, asked: list[int], count: int, settings: SeathruSettings
) -> list[WaterSamples]:
    """About `count` pixels of a frame on their own, and of open water, if it shows any.

    Pixels without a measured depth are as the frames `asked` show them.
    """
    index, camera = frames.index(rec.names[i]), rec.cameras[i]
    image, mask = frames.image(index), frames.mask(index)
    z_depth, near, sea = _depth_everywhere(image, rec.depth[rec.names[i]])
    ray_depth = ray_depth_map(z_depth, frame_rays(camera)).reshape(-1)
    pixels = torch.nonzero((ray_depth > 0) & mask.reshape(-1))[:, 0]
    pixels = pixels[:: max(1, len(pixels) // count)]
    pixels, guessed = pixels[near.reshape(-1)[pixels]], pixels[~near.reshape(-1)[pixels]]
    shown = torch.nonzero((sea & mask).reshape(-1))[:, 0]
    shown = shown[:: max(1, -(-len(shown) // settings.open_water_pixels))]
    colors, direction = quiet(image, mask).reshape(-1, 3), frame_directions(camera).reshape(-1, 3)
    own = WaterSamples(
        colors[pixels], ray_depth[pixels], torch.full_like(pixels, i), torch.full_like(pixels, -1),
        image.reshape(-1, 3)[shown], frames.gray, torch.zeros_like(pixels) > 0, direction[pixels], direction[shown],
    )  # fmt: skip
    places = pixel_grid(*sea.shape).reshape(-1, 2)[None, guessed].double()
    points = unproject(camera, places, z_depth.reshape(1, -1)[:, guessed].double())
    return [own, _brightest_views(rec, frames, [i, *asked], points[0])]


def _depth_everywhere(
    image: Float[Tensor, "h w 3"], depth: DepthMap
) -> tuple[Float[Tensor, "h w"], Bool[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """z depth, filled in; pixels that are near to measured ones; and open water, whose depth is 0."""
    known = depth.z_depth > 0
    if not known.any():
        nowhere = torch.zeros_like(known)
        return torch.zeros_like(depth.z_depth), nowhere, nowhere
    sea = open_water_mask(image, depth.z_depth)
    filled = torch.where(sea, 0.0, fill_z_depth(image, depth, sea.float()))
    reach = 0.02 * max(image.shape[:2])
    return filled, (blur(known.float()[..., None], reach)[..., 0] > 0.1) & ~sea, sea


def quiet(image: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"]) -> Float[Tensor, "h w 3"]:
    """An image whose pixels are averaged with those around them, with none outside the mask.

    The darkest of single pixels are those with the most negative noise, which lie below the backscatter.
    """
    share = mask[..., None].float()
    return blur(image * share, _QUIET) / blur(share, _QUIET).clamp_min(1e-6)


def _brightest_views(
    rec: Reconstruction, frames: Frames, views: list[int], points: Float[Tensor, "p 3"]
) -> WaterSamples:
    """The points that at least two of the frames `views` show, each as the frame shows it in which it is brightest.

    That is the ground behind a dark thing that moves over it, and is not of its depth; black ground stays black.
    """
    none, times = torch.zeros(0, 3), torch.zeros(len(points), dtype=torch.long)
    I, toward, frame = torch.full((len(points), 3), -1.0), torch.zeros(len(points), 3), times.clone()
    for j in views:
        index, camera = frames.index(rec.names[j]), rec.cameras[j]
        seen, _, inside = project_visible(camera, points[None])
        rows = torch.nonzero(inside[0])[:, 0]
        x, y = seen[0, rows].long().unbind(-1)
        image, mask = quiet(frames.image(index), frames.mask(index)), frames.mask(index)
        shown = mask[y, x]
        rows, color = rows[shown], image[y[shown], x[shown]]
        brighter = color.mean(-1) > I[rows].mean(-1)
        times[rows] += 1
        rows = rows[brighter]
        world2cam = camera.world2cam[0].to(points)
        I[rows], frame[rows] = color[brighter], j
        toward[rows] = (points[rows] @ world2cam[:3, :3].mT + world2cam[:3, 3]).float()
    again = times > 1
    ray_depth = toward[again].norm(dim=-1)
    return WaterSamples(
        I[again], ray_depth, frame[again], torch.full_like(frame[again], -1), none,
        frames.gray, torch.ones_like(frame[again]) > 0, toward[again] / ray_depth[:, None], none,
    )  # fmt: skip


def _plausible_water(
    open_water: Float[Tensor, "m 3"], I: Float[Tensor, "n 3"], ray_depth: Float[Tensor, " n"]
) -> Bool[Tensor, " m"]:
    """False where darker than the dark envelope of the farthest tenth: veil grows with distance, shadow does not."""
    if len(open_water) == 0 or len(I) == 0:
        return torch.ones(len(open_water), dtype=torch.bool)
    far = ray_depth >= torch.quantile(ray_depth[:: max(1, len(ray_depth) // 100_000)], 0.9)
    envelope = torch.quantile(I[far][:100_000], 0.02, dim=0)
    return (open_water >= envelope - 0.02).all(-1)
