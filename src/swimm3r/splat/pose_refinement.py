"""A camera's pose refined against a frozen map: the protocol that test frames are scored under.

The protocol is that of 3R-GS (docs/derivations/compared-methods.md#3r-gs):

    cam2world' = cam2world [R(w) | length v]

with a 9-vector (v, w), zero at first, w added to the 6D form of the identity. The loss is a mean absolute difference
to the image I, over all pixels x or over edges alone, as 3R-GS has it (pixels whose Scharr gradient exceeds four
medians):

    all      mean of |d(x) - (G * d)(x)|,    d = rendering - I, G a Gaussian as wide as an 80th of the image
    edges    mean of |d(x)|

Without its local mean, a difference says nothing of light, water and exposure, which change slowly over an image and
draw poses aside. Either loss has a minimum within a few pixels only, so that smaller images are looked at first.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d

from swimm3r.cameras import Cameras
from swimm3r.evaluate.registration import fit_colors
from swimm3r.imaging.undistortion import undistorted
from swimm3r.progress import Progress, silent
from swimm3r.raster.cpu.threads import threads_for_kernels_alone
from swimm3r.splat.pose_mlp import moved
from swimm3r.splat.primitives.beta import select
from swimm3r.splat.primitives.kinds import Primitives
from swimm3r.splat.projection.dispatch import project
from swimm3r.splat.projection.observed import TrainingCoverage
from swimm3r.splat.projection.view_camera import view_camera
from swimm3r.splat.rendering import SplatMap, expected_z_depth, images, memory_for_views, settings_in_scene_units
from swimm3r.splat.settings import PoseRefinementSettings

_DARK = 0.01  # sum of R, G, B below which a pixel is no edge
_EDGE = 4.0  # medians of the image's gradient
_FEW = 0.01  # of the image, fewer edges or observed pixels than which stand for none
_SLOW = 1 / 80  # of the longer side: standard deviation of the window of local means
_TILE = 16  # pixels, from which on differences are independent
_SMALLEST = 60  # pixels of the longer side, below which an image no longer tells a pose
_STAY = 1e-3  # hold of colors to the map's, `evaluate.registration.fit_colors`
_MARGIN = 0.25  # of the image, within which primitives outside it are kept: the pose moves


@dataclass(frozen=True)
class RefinedPose:
    """A camera after refinement, and how well it explains its image."""

    camera: Cameras  # as given, with another pose
    start_loss: float  # 0..1
    loss: float


@memory_for_views
@threads_for_kernels_alone()
def refine_pose(
    scene: SplatMap,
    camera: Cameras,
    image: Float[Tensor, "h w 3"],
    mask: Bool[Tensor, "h w"],
    settings: PoseRefinementSettings | None = None,
    progress: Progress = silent,
    time: float | None = None,
) -> RefinedPose:
    """The pose near `camera`'s from which the map looks most like the image; the given one where that gain is chance.

    `image` and `mask` are the frame as prepared, distortion included; `time` is when it was taken, seconds.
    """
    settings = settings or PoseRefinementSettings()
    delta = torch.zeros(9, requires_grad=True)
    whole = camera.drawn(scene.settings.long_side)
    sides = sizes(settings, max(whole.width, whole.height))
    looks = [_Look(scene, camera, image, mask, settings, side, time) for side in sides]
    done, first = 0, delta.detach().clone()
    for look, until in zip(looks, ends(settings.steps, len(looks)), strict=True):
        adam = torch.optim.Adam([delta], lr=settings.rate)
        for step in range(count := until - done):
            progress("refining a pose", done + step, settings.steps)
            adam.param_groups[0]["lr"] = settings.rate * 0.01 ** (step / count)
            (delta.grad,) = torch.autograd.grad(look.loss(delta), [delta])
            adam.step()
        done = until
    progress("refining a pose", settings.steps, settings.steps)
    last = looks[-1]
    with torch.no_grad():
        before, after, pose = last.differences(first), last.differences(delta), last.pose(delta)
    start, end = float(last.mean(before)), float(last.mean(after))
    if last.standard_errors(before - after) > settings.min_gain:
        return RefinedPose(replace(camera, cam2world=pose[None]), start, end)
    return RefinedPose(camera, start, start)


class _Look:
    """A camera's image at one size, and how far the map is from it where the camera has moved to."""

    def __init__(
        self,
        scene: SplatMap,
        camera: Cameras,
        image: Float[Tensor, "h w 3"],
        mask: Bool[Tensor, "h w"],
        settings: PoseRefinementSettings,
        long_side: int,
        time: float | None,
    ) -> None:
        self._scene, self._now = scene, scene.normalized_time(time)
        self._canvas = camera.drawn(long_side)
        target, seen = undistorted(image, mask, camera, self._canvas)
        self._local = settings.pixels == "all"
        wanted = seen if self._local else edges(target, seen)
        self._target, self._seen, self._wanted = (x.to(scene.device) for x in (target, seen, wanted))
        self._units = settings_in_scene_units(scene.settings, scene.length)
        self._primitives = in_sight(scene, self._canvas, self._now)
        if scene.coverage is not None:
            self._leave_out(~self._observed(scene.coverage))

    def _observed(self, coverage: TrainingCoverage) -> Bool[Tensor, "h w"]:
        """Mask of what training frames saw of the first pose's view."""
        with torch.no_grad():
            view = view_camera(self._canvas).to(self._scene.device)
            shown = images(self._primitives, self._scene.field, view, self._units, self._now)
        return coverage.of_view(self._canvas, expected_z_depth(shown), shown.alpha).to(self._scene.device)

    def _leave_out(self, unknown: Bool[Tensor, "h w"]) -> None:
        """Take no account of pixels that the map cannot know, unless hardly any is left."""
        known = self._wanted & ~unknown
        if int(known.sum()) >= _FEW * known.numel():
            self._wanted, self._seen = known, self._seen & ~unknown

    def pose(self, delta: Float[Tensor, "9"]) -> Float[Tensor, "4 4"]:
        """cam2world after the motion."""
        return moved(self._canvas.cam2world[0], delta, self._scene.length)

    def loss(self, delta: Float[Tensor, "9"]) -> Float[Tensor, ""]:
        """Mean absolute difference."""
        return self.mean(self.differences(delta))

    def differences(self, delta: Float[Tensor, "9"]) -> Float[Tensor, "h w"]:
        """Absolute difference at each pixel that counts, 0 elsewhere."""
        view = view_camera(replace(self._canvas, cam2world=self.pose(delta)[None])).to(self._scene.device)
        rgb = images(self._primitives, self._scene.field, view, self._units, self._now).rgb
        rgb = rgb.permute(1, 2, 0)
        if self._scene.colors is not None:  # the frame has colors of its own: they say nothing about the pose
            rgb = fit_colors(rgb.detach()[self._seen], self._target[self._seen], _STAY)(rgb)
        off = rgb - self._target
        if self._local:
            off = off - local_mean(off, self._seen, max(1.0, _SLOW * max(self._seen.shape)))
        return off.abs().mean(-1) * self._wanted

    def mean(self, values: Float[Tensor, "h w"]) -> Float[Tensor, ""]:
        """Mean over the pixels that count."""
        return values.sum() / self._wanted.sum()

    def standard_errors(self, values: Float[Tensor, "h w"]) -> float:
        """Mean over the pixels that count, in its standard errors as tiles of the image tell them; 0 of zeros."""
        sums, counts = (
            avg_pool2d(x[None].float(), _TILE, ceil_mode=True, divisor_override=1) for x in (values, self._wanted)
        )
        mean = self.mean(values)
        error = (sums - mean * counts).norm() / self._wanted.sum()
        return float(mean / error) if error > 0 else 0.0


def local_mean(values: Float[Tensor, "h w c"], seen: Bool[Tensor, "h w"], sigma: float) -> Float[Tensor, "h w c"]:
    """Mean of the seen values around each pixel, in a Gaussian window of `sigma` pixels; 0 where none is near."""
    reach = math.ceil(3 * sigma)
    weights = torch.exp(-0.5 * (torch.arange(-reach, reach + 1, device=values.device) / sigma) ** 2)
    weights = (weights / weights.sum()).to(values)
    there = seen.to(values)[..., None]
    sums = torch.cat([values * there, there], -1).permute(2, 0, 1)[:, None]
    sums = conv2d(sums, weights[None, None, None], padding=(0, reach))
    sums = conv2d(sums, weights[None, None, :, None], padding=(reach, 0))[:, 0].permute(1, 2, 0)
    return sums[..., :-1] / sums[..., -1:].clamp(min=1e-6)


def sizes(settings: PoseRefinementSettings, long_side: int) -> list[int]:
    """Longer sides of the images that are compared in turn; `long_side` is the map's own."""
    largest = min(settings.long_side or long_side, long_side)
    return [largest >> k for k in range(settings.halvings, 0, -1) if largest >> k >= _SMALLEST] + [largest]


def ends(steps: int, count: int) -> list[int]:
    """The steps after which each of the sizes is left: the smaller ones share the first half."""
    return [steps * k // (2 * (count - 1)) for k in range(1, count)] + [steps]


def edges(target: Float[Tensor, "h w 3"], seen: Bool[Tensor, "h w"]) -> Bool[Tensor, "h w"]:
    """The pixels of strong gradients; every pixel where the image has too few of them."""
    import cv2

    gray = target.mean(-1).numpy()
    gradient = np.hypot(cv2.Scharr(gray, cv2.CV_32F, 1, 0), cv2.Scharr(gray, cv2.CV_32F, 0, 1))
    usable = seen & (target.sum(-1) > _DARK)
    strong = usable & torch.from_numpy(gradient > _EDGE * np.median(gradient))
    return strong if int(strong.sum()) >= _FEW * strong.numel() else usable


def in_sight(scene: SplatMap, canvas: Cameras, now: Float[Tensor, ""] | None = None) -> Primitives:
    """The primitives that a camera sees, or would after a small motion."""
    with torch.no_grad():
        view = view_camera(canvas).to(scene.device)
        p = scene.seen_by(view.widened(_MARGIN))
        seen = project(p, view, settings_in_scene_units(scene.settings, scene.length).render, now)
    size = torch.tensor([canvas.width, canvas.height]).to(seen.radius)
    reach = seen.radius[:, None] + _MARGIN * size
    at = seen.primitives.mean2d
    near = ((at > -reach) & (at < size + reach)).all(-1) & (seen.primitives.depth > 0)
    return select(p, near)
