"""Primitives for what moves, which the still scene that a dynamic map starts from does not have.

Early in training the map shows the ground. Where one frame looks otherwise, and the frames that see the same ground at
other times do not, something came between: `moving_pixels`. There primitives are born in that frame, before the ground,
for a moment around its time, travelling as the optical flow to the frames before and after says (`travel`). A single
moving camera cannot tell how far away they are; a share of the ground's distance is assumed, which their travel makes
good in the frames between.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, interpolate, normalize

from swimm3r.cameras import Cameras, directions, pixel_grid, project, ray_depth_from_z, resized, unproject
from swimm3r.medium import Medium, remove_water
from swimm3r.splat.medium_field import MediumField
from swimm3r.splat.primitives import BetaPrimitives
from swimm3r.splat.projection import pinhole
from swimm3r.splat.rendering import draw, expected_z_depth
from swimm3r.splat.settings import UwbsSettings
from swimm3r.splat.travel import followed, full_size, mean_velocity, travelling
from swimm3r.splat.views import TrainingViews, View

_LONG_SIDE = 160  # of the pictures in which movement is looked for, pixels
_BLUR = 5  # side of the square that differences are averaged over
_OTHERS = 8  # frames at other times, spread over the clip, that are asked about a frame's ground
_HIDDEN = 0.8  # of a point's depth in another frame: what is nearer there hides it
_BEYOND = 100.0  # distances of a frame's far ground at which open water is taken to be
_SEEDS = 6  # pixels of a part that must differ clearly
_SPACING = 3.0  # pixels between primitives that are born, at least


@dataclass(frozen=True)
class Residual:
    """Where a map and a frame differ, and how far away the map's ground is; at most 160 pixels wide."""

    camera: Cameras
    off: Float[Tensor, "h w"]  # difference of the blurred pictures, as texture not yet learned averages out
    z_depth: Float[Tensor, "h w"]  # of open water: far away
    reach: float  # z depth of the frame's far ground
    seen: Bool[Tensor, "h w"]


def residual(p: BetaPrimitives, field: MediumField, view: View, settings: UwbsSettings) -> Residual:
    """A frame against the map at the frame's own time, without gradient."""
    scale = min(1.0, _LONG_SIDE / max(view.camera.width, view.camera.height))
    width, height = max(8, round(scale * view.camera.width)), max(8, round(scale * view.camera.height))
    camera = resized(view.camera, width, height)
    with torch.no_grad():
        images = draw(p, field, pinhole(camera), settings, view.time).images
    target = interpolate(view.rgb[None], (height, width), mode="area")[0]
    seen = interpolate(view.seen[None, None].float(), (height, width), mode="area")[0, 0] > 0.999
    off = torch.where(seen, images.rgb - target, 0.0)
    off = avg_pool2d(off, _BLUR, 1, _BLUR // 2, count_include_pad=False).abs().mean(0)
    z_depth = expected_z_depth(images)
    ground = images.alpha > 0.5
    reach = float(z_depth[ground].quantile(0.9)) if bool(ground.any()) else settings.working_depth
    return Residual(camera, off, torch.where(ground, z_depth, _BEYOND * reach), reach, seen)


def moving_pixels(mine: Residual, others: Sequence[Residual], contrast: float, least: float) -> Bool[Tensor, "h w"]:
    """Where a frame differs from the map `contrast` times as much as the others that see the same ground, or water.

    That is more than their median, of two frames at least, and by `least` of the full range. The regions around such
    pixels that differ half as much are part of what moves: it may here and there look like the ground.
    """
    height, width = mine.off.shape
    camera = mine.camera
    ground = unproject(camera, pixel_grid(height, width).reshape(1, -1, 2), mine.z_depth.reshape(1, -1))
    rows = []
    for other in others:
        pixels, z = project(other.camera, ground)
        at = 2 * pixels.reshape(1, 1, -1, 2) / torch.tensor([other.camera.width, other.camera.height]) - 1
        maps = torch.stack([other.off, other.z_depth, other.seen.float()])[None]
        off, there, seen = grid_sample(maps, at.to(maps), align_corners=False)[0, :, 0]
        same = (seen > 0.999) & (z[0] > 0) & (there > _HIDDEN * z[0])
        rows.append(torch.where(same, off, torch.nan))
    known = torch.stack(rows)
    enough = (known.isfinite().sum(0) >= 2).reshape(height, width)
    usual = known.nanmedian(0).values.reshape(height, width).nan_to_num()
    asked, clearly = mine.seen & enough, (contrast * usual).clamp(min=least)
    return _grown(asked & (mine.off > clearly), asked & (mine.off > clearly / 2))


def born(
    p: BetaPrimitives, field: MediumField, views: TrainingViews, settings: UwbsSettings, rng: torch.Generator
) -> BetaPrimitives:
    """The primitives that come to a dynamic map for what moves in the frames; none where nothing does.

    At most `MoverSettings.share` of the largest number of primitives.
    """
    m = settings.movers
    residuals = [residual(p, field, views[k], settings) for k in range(len(views))]
    masks = []
    for k, mine in enumerate(residuals):
        apart = [j for j in range(len(views)) if j != k]
        spread = np.unique(np.linspace(0, len(apart) - 1, min(_OTHERS, len(apart))).round().astype(int))
        others = [residuals[apart[j]] for j in spread]
        masks.append(moving_pixels(mine, others, m.contrast, m.least) if others else torch.zeros_like(mine.seen))
    area = sum(float(mask.sum()) / mask.numel() * views[k].rgb[0].numel() for k, mask in enumerate(masks))
    most = round(m.share * settings.densify.max_primitives)
    spacing = max(_SPACING, (area / max(1, most)) ** 0.5)
    interval = float(np.median(np.diff(views.times))) if len(views) > 1 else 1.0
    parts = [
        _of_frame(field, views, masks, k, residuals[k], spacing, m.duration * interval, settings, rng)
        for k, mask in enumerate(masks)
        if bool(mask.any())
    ]
    if not parts:
        return BetaPrimitives(*(values[:0] for values in p))
    return BetaPrimitives(*(torch.cat(values) for values in zip(*parts, strict=True)))


def _of_frame(
    field: MediumField,
    views: TrainingViews,
    masks: Sequence[Bool[Tensor, "h w"]],
    k: int,
    found: Residual,
    spacing: float,
    duration: float,
    settings: UwbsSettings,
    rng: torch.Generator,
) -> BetaPrimitives:
    """Primitives at random pixels of a frame's moving parts, `spacing` apart on average, freed from the water."""
    view, width = views[k], views[k].camera.width
    rows = ((full_size(masks[k], view) > 0) & view.seen).reshape(-1).nonzero()[:, 0]
    count = max(1, round(len(rows) / spacing**2))
    rows = rows[torch.randperm(len(rows), generator=rng)[:count]]
    pixels = torch.stack([rows % width, rows // width], -1) + torch.rand(len(rows), 2, generator=rng)
    near = [j for j in (k - 1, k + 1) if 0 <= j < len(views)]
    ways = [way for j in near if (way := followed(view, masks[k], views[j], masks[j], pixels)) is not None]
    z = settings.movers.nearness * full_size(found.z_depth.clamp(max=found.reach), view).reshape(-1)[rows]
    xyz = unproject(view.camera, pixels[None], z[None])[0]
    towards = normalize(xyz - view.camera.centres[0].to(xyz), dim=-1)
    colours = view.rgb.reshape(3, -1).mT[rows]
    if settings.medium.model == "network":
        with torch.no_grad():
            Binf, beta_B, beta_D = field(towards[None].float(), view.time)[:, 0].mT.split(3, -1)
        ray_depth = ray_depth_from_z(z, directions(view.camera, pixels[None])[0])
        colours = remove_water(colours, ray_depth, Medium(Binf, beta_D, beta_B)).clamp(0, 1)
    assert view.time is not None
    return travelling(
        xyz,
        mean_velocity(xyz, z, ways),
        towards,
        float(view.time),
        radius=spacing * z / float(view.camera.K[0, 0, 0]),
        duration=duration,
        rgb=colours,
        opacity=settings.initial.opacity,
    )


def _grown(seeds: Bool[Tensor, "h w"], region: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """The parts of a region, its small gaps closed and its specks gone, that a few of the seeds lie in."""
    import cv2

    closed = cv2.morphologyEx(region.numpy().astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    opened = cv2.morphologyEx(closed, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, part = cv2.connectedComponents(opened)
    part = torch.from_numpy(np.asarray(part, np.int64))
    hits = torch.bincount(part[seeds], minlength=count)
    hits[0] = 0  # what is no part
    return hits[part] >= _SEEDS
