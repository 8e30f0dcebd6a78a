"""Motion masks: pixels that neither the static map nor the other frames explain.

Early in training a map shows the ground, and here and there already a ghost of what moved before it. So two questions
are asked of a frame: does it differ from the map, and from the images of the same ground at other times? What does
both, much more than the other frames do at that ground, came between.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, interpolate

from swimm3r.cameras import Cameras, pixel_grid, project, resized, unproject
from swimm3r.splat.medium.field import MediumField
from swimm3r.splat.primitives.beta import BetaPrimitives
from swimm3r.splat.projection.view_camera import view_camera
from swimm3r.splat.rendering import draw, expected_z_depth
from swimm3r.splat.settings import UwbsSettings
from swimm3r.splat.views import TrainingView, TrainingViews

_LONG_SIDE = 160  # of the images in which movement is looked for, pixels
_BLUR = 5  # side of the square that differences are averaged over
_OTHERS = 12  # frames at other times, spread over the clip, that are asked about a frame's ground
_HIDDEN = 0.8  # of a point's depth in another frame: what is nearer there hides it
_BEYOND = 100.0  # distances of a frame's far ground at which open water is taken to be
_SEEDS = 6  # pixels of a part that must differ clearly


@dataclass(frozen=True)
class MotionView:
    """A small image of a frame, how far it is off what was expected, and how far away the map's ground is."""

    camera: Cameras  # at most 160 pixels wide
    rgb: Float[Tensor, "3 h w"]
    off: Float[Tensor, "h w"]  # of blurred images, as texture not yet learned averages out
    z_depth: Float[Tensor, "h w"]  # of open water: far away
    reach: float  # z depth of the frame's far ground
    seen: Bool[Tensor, "h w"]


def moving_parts(
    p: BetaPrimitives, field: MediumField, views: TrainingViews, settings: UwbsSettings
) -> tuple[list[MotionView], list[list[Bool[Tensor, "h w"]]]]:
    """All frames, and the masks of each one's moving parts."""
    m = settings.movers
    views_seen = [motion_view(p, field, views[k], settings) for k in range(len(views))]
    others = [_spread([j for j in range(len(views_seen)) if j != k]) for k in range(len(views_seen))]
    views_seen = [against_others(mine, [views_seen[j] for j in others[k]]) for k, mine in enumerate(views_seen)]
    masks = [
        moving_pixels(mine, [views_seen[j] for j in others[k]], m.contrast, m.least)
        for k, mine in enumerate(views_seen)
    ]
    return views_seen, [_parts(mask) for mask in masks]


def motion_view(p: BetaPrimitives, field: MediumField, view: TrainingView, settings: UwbsSettings) -> MotionView:
    """A frame against the map at the frame's own time, without gradient."""
    scale = min(1.0, _LONG_SIDE / max(view.camera.width, view.camera.height))
    width, height = max(8, round(scale * view.camera.width)), max(8, round(scale * view.camera.height))
    camera = resized(view.camera, width, height)
    with torch.no_grad():
        images = draw(p, field, view_camera(camera), settings, view.time).images
    target = interpolate(view.rgb[None], (height, width), mode="area")[0]
    seen = interpolate(view.seen[None, None].float(), (height, width), mode="area")[0, 0] > 0.999
    off = _blurred(torch.where(seen, images.rgb - target, 0.0)).abs().mean(0)
    z_depth = expected_z_depth(images)
    ground = images.alpha > 0.5
    reach = float(z_depth[ground].quantile(0.9)) if bool(ground.any()) else settings.working_depth
    return MotionView(camera, target, off, torch.where(ground, z_depth, _BEYOND * reach), reach, seen)


def against_others(mine: MotionView, others: Sequence[MotionView]) -> MotionView:
    """No further off than half of the other frames that see the same ground are from this one.

    That is asked twice, of the map's ground and of a plane as far away as the far ground, because a ghost in the map
    hides what is behind it; where less than a third of the others see the place they are not believed.
    """
    blurred = _blurred(mine.rgb).flatten(1)
    off = mine.off
    for z_depth in (mine.z_depth, torch.full_like(mine.z_depth, mine.reach)):
        rows = []
        for other in others:
            there, _ = _there(mine, other, torch.cat([_blurred(other.rgb), other.seen[None].float()]), z_depth)
            rows.append(torch.where(there[3] > 0.999, (there[:3] - blurred).abs().mean(0), torch.nan))
        known = torch.stack(rows)
        asked = known.isfinite().sum(0) >= max(2, len(others) / 3)
        difference = torch.where(asked, known.nanmedian(0).values, torch.inf)
        off = torch.minimum(off, difference.reshape(off.shape))
    return replace(mine, off=off)


def moving_pixels(mine: MotionView, others: Sequence[MotionView], contrast: float, least: float) -> Bool[Tensor, "h w"]:
    """Pixels whose error is `contrast` times that of the other frames which see the same ground, or water.

    That is more than their median, of two frames at least, and by `least` of the full range. The regions around such
    pixels that are off half as much are part of what moves: it may here and there look like the ground.
    """
    if not others:
        return torch.zeros_like(mine.seen)
    rows = []
    for other in others:
        there, z = _there(mine, other, torch.stack([other.off, other.z_depth, other.seen.float()]), mine.z_depth)
        off, surface, seen = there
        rows.append(torch.where((seen > 0.999) & (surface > _HIDDEN * z), off, torch.nan))
    known = torch.stack(rows)
    enough = (known.isfinite().sum(0) >= 2).reshape(mine.off.shape)
    usual = known.nanmedian(0).values.reshape(mine.off.shape).nan_to_num()
    asked, clearly = mine.seen & enough, (contrast * usual).clamp(min=least)
    return _grown(asked & (mine.off > clearly), asked & (mine.off > clearly / 2))


def _there(
    mine: MotionView, other: MotionView, maps: Float[Tensor, "c h w"], z_depth: Float[Tensor, "h w"]
) -> tuple[Float[Tensor, "c n"], Float[Tensor, " n"]]:
    """Another frame's maps where it sees what this one's pixels see at the z depths, 0 where it does not; z there."""
    height, width = z_depth.shape
    points = unproject(mine.camera, pixel_grid(height, width).reshape(1, -1, 2), z_depth.reshape(1, -1))
    pixels, z = project(other.camera, points)
    at = 2 * pixels.reshape(1, 1, -1, 2) / torch.tensor([other.camera.width, other.camera.height]) - 1
    return grid_sample(maps[None], at.to(maps), align_corners=False)[0, :, 0] * (z > 0), z[0]


def _spread(frames: Sequence[int]) -> list[int]:
    at = np.unique(np.linspace(0, len(frames) - 1, min(_OTHERS, len(frames))).round().astype(int))
    return [frames[i] for i in at]


def _blurred(image: Float[Tensor, "3 h w"]) -> Float[Tensor, "3 h w"]:
    return avg_pool2d(image, _BLUR, 1, _BLUR // 2, count_include_pad=False)


def _grown(seeds: Bool[Tensor, "h w"], region: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """The parts of a region, its small gaps closed and its specks gone, that a few of the seeds lie in."""
    import cv2

    closed = cv2.morphologyEx(region.numpy().astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    opened = cv2.morphologyEx(closed, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    parts = _parts(torch.from_numpy(opened) > 0)
    kept = [part for part in parts if int((part & seeds).sum()) >= _SEEDS]
    return torch.stack(kept).any(0) if kept else torch.zeros_like(seeds)


def _parts(mask: Bool[Tensor, "h w"]) -> list[Bool[Tensor, "h w"]]:
    """The connected components."""
    import cv2

    count, number = cv2.connectedComponents(mask.numpy().astype(np.uint8))
    return [torch.from_numpy(number == i) for i in range(1, count)]
