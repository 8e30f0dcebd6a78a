"""A camera's pose refined against a frozen map: the protocol that test frames are scored under (uwbs.md 4.2).

    cam2world' = cam2world [R(w) | length v]

with a 9-vector (v, w), zero at first, w added to the 6D form of the identity. The loss is the mean absolute difference
to the picture over its edges: pixels whose Scharr gradient exceeds a few medians.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.cameras import Cameras
from swimm3r.progress import Progress, silent
from swimm3r.splat.pose_codes import moved
from swimm3r.splat.primitives import select
from swimm3r.splat.projection import Primitives, pinhole, project
from swimm3r.splat.rendering import SplatMap, in_scene_units, pictures
from swimm3r.splat.settings import PoseRefinementSettings
from swimm3r.splat.views import pinhole_canvas, undistorted

_DARK = 0.01  # sum of R, G, B below which a pixel is not looked at
_MARGIN = 0.25  # of the picture, within which primitives outside it are kept: the pose moves


@dataclass(frozen=True)
class RefinedPose:
    """A camera after refinement, and how well it explains its picture."""

    camera: Cameras  # as given, with another pose
    start_loss: float  # mean absolute difference over the edges, 0..1
    loss: float


def refine_pose(
    scene: SplatMap,
    camera: Cameras,
    picture: Float[Tensor, "h w 3"],
    mask: Bool[Tensor, "h w"],
    settings: PoseRefinementSettings | None = None,
    progress: Progress = silent,
    time: float | None = None,
) -> RefinedPose:
    """The pose near `camera`'s from which the map looks most like the picture; the given one where none looks better.

    `picture` and `mask` are the frame as prepared, distortion included; `time` is when it was taken, seconds.
    """
    settings = settings or PoseRefinementSettings()
    canvas = pinhole_canvas(camera, settings.long_side)
    target, seen = undistorted(picture, mask, camera, canvas)
    wanted = edges(target, seen, settings)
    units = in_scene_units(scene.settings, scene.length)
    now = scene.moment(time)
    primitives = in_sight(scene, canvas, now)
    delta = torch.zeros(9, requires_grad=True)
    adam = torch.optim.Adam([delta], lr=settings.rate)
    losses: list[tuple[float, Tensor]] = []
    for step in range(settings.steps + 1):
        progress("refining a pose", step, settings.steps)
        pose = moved(canvas.cam2world[0], delta, scene.length)
        images = pictures(primitives, scene.field, pinhole(replace(canvas, cam2world=pose[None])), units, now)
        loss = ((images.rgb.permute(1, 2, 0) - target).abs().mean(-1) * wanted).sum() / wanted.sum()
        losses.append((float(loss.detach()), pose.detach()))
        if step == settings.steps:
            break
        adam.param_groups[0]["lr"] = settings.rate * 0.01 ** (step / settings.steps)
        (delta.grad,) = torch.autograd.grad(loss, [delta])
        adam.step()
    start, end = losses[0], losses[-1]
    best = end if end[0] < start[0] else start
    return RefinedPose(replace(camera, cam2world=best[1][None]), start[0], best[0])


def edges(
    target: Float[Tensor, "h w 3"], seen: Bool[Tensor, "h w"], settings: PoseRefinementSettings
) -> Bool[Tensor, "h w"]:
    """The pixels that tell a pose: strong gradients; every pixel where the picture has too few of them."""
    import cv2

    grey = target.mean(-1).numpy()
    gradient = np.hypot(cv2.Scharr(grey, cv2.CV_32F, 1, 0), cv2.Scharr(grey, cv2.CV_32F, 0, 1))
    usable = seen & (target.sum(-1) > _DARK)
    strong = usable & torch.from_numpy(gradient > settings.edge * np.median(gradient))
    return strong if int(strong.sum()) >= settings.min_edges * strong.numel() else usable


def in_sight(scene: SplatMap, canvas: Cameras, now: Float[Tensor, ""] | None = None) -> Primitives:
    """The primitives that a camera sees, or would after a small motion."""
    with torch.no_grad():
        seen = project(scene.primitives, pinhole(canvas), in_scene_units(scene.settings, scene.length).render, now)
    size = torch.tensor([canvas.width, canvas.height])
    reach = seen.radius[:, None] + _MARGIN * size
    at = seen.primitives.mean2d
    near = ((at > -reach) & (at < size + reach)).all(-1) & (seen.primitives.depth > 0)
    return select(scene.primitives, near)
