"""Sunlight that flickers over the ground: caustics, which waves focus, evened out frame by frame.

    I'_f = I_f + (gamma_f - 1) (I_f - B),    gamma_f(x) = mean_g L_g(x) / L_f(x)

L_g is the brightness of the surface at pixel x in frame g, sum_c (I - B)_c / sum_c T_D,c with the water that structure
from motion measured, and the mean is over the frames that see it, f among them. Patterns of light move in a second or
so and the surface stays, so the mean of many frames is close to its color in steady light (registered frames against
sunlight flicker: Gracias et al. 2008, "A motion compensated filtering approach to remove sunlight flicker"). Both
sides of the ratio are blurred: gamma has the scale of the patterns, and detail remains the frame's own. The ratio
stands for light on values as stored, too: a power of it is a factor as well.

Frames are compared at the size at which `sfm.moving` compares them. Whether there is flicker at all is told by a few
of them, each beside its second next: by the spread of log(L_g / L_f) about its own large-scale part, which is exposure.
Errors of water and lens, and surfaces that shine, change brightness too, but slowly along the path of the camera; what
depends on the brightness of surfaces alone is left out. A camera that tones frames locally changes them over a third of
the image and more: where a shading (`swimm3r.appearance`) explains as much of the spread as it takes to fit shadings,
the change is the camera's.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from swimm3r.appearance import image_cosines
from swimm3r.cameras import project_visible
from swimm3r.imaging.undistortion import frame_directions, frame_rays
from swimm3r.io import images
from swimm3r.io.files.atomic import atomic_folder
from swimm3r.medium import MediumFit, backscatter, transmittances
from swimm3r.progress import Progress, silent
from swimm3r.scene.frame_changes import SteadyFrames
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import QualityWarning, Reconstruction
from swimm3r.sfm.medium.dense_tracks import ray_depth_map
from swimm3r.sfm.medium.restore import restore_image
from swimm3r.sfm.medium.settings import RestoreSettings
from swimm3r.sfm.medium.side_by_side import in_order
from swimm3r.sfm.moving.still_scene import StillScene, still_scene

log = logging.getLogger(__name__)

_PROBES = 4  # frames that tell whether the light flickers
_NEXT = 2  # places in time to the frame that they are compared with
_FLICKERS = 0.032  # spread of the change, per frame, from which on it does; strobes that near the ground reach 0.03
_TONED = 0.45  # share of the spread's square that shadings explain, from where it is the camera's; as `least_shading`
_FITS = 5  # of a shading, observations that miss counting less each time
_SAME = 0.03  # of a depth, within which two frames see the same surface
_TELLING = 0.25  # of an image, below which its measured part tells nothing
_LEAST_CHANGE = 0.012  # of brightness itself, 0..1: on dark ground a small error of the water is a large ratio
_LEAST_FRAMES = 4  # that see a surface, for their mean to stand for it
_SMOOTH, _FILL, _LARGE = 1.5, 8.0, 30.0  # pixels of the small images: scale of gamma, of gaps, of what is no flicker
_HOLD, _FAR_HOLD = 0.1, 0.05  # weight of a gap's surroundings beside measured pixels, and of 1 beside surroundings
_DARKEST = 0.01  # brightness, below which ratios are noise
_MOST = float(np.log(2.0))  # of |log gamma|


@dataclass(frozen=True)
class Flicker:
    """Logarithms of the brightness of surfaces elsewhere, over that in one small image."""

    log_gain: Float[np.ndarray, "h w"]  # everywhere; toward 0 away from what is measured
    measured: Bool[np.ndarray, "h w"]  # surfaces that enough frames see

    @property
    def spread(self) -> float:
        """Robust standard deviation of the log gain about its large-scale part, on measured pixels; NaN on too few."""
        weight = self.measured.astype(np.float32)
        large = _blurred(self.log_gain * weight, _LARGE) / np.maximum(_blurred(weight, _LARGE), 1e-6)
        left = np.abs(self.log_gain - large)[self.measured]
        return 1.4826 * float(np.median(left)) if len(left) >= _TELLING * weight.size else float("nan")

    def beyond_shading(self) -> "Flicker":
        """The same without the shading that explains most of the measured pixels (robust least squares)."""
        at = self.measured
        waves = image_cosines(*at.shape).permute(1, 2, 0).numpy()[at]
        terms = np.concatenate([np.ones((len(waves), 1)), waves], 1).astype(np.float64)
        y, weight = self.log_gain[at].astype(np.float64), np.ones(len(terms))
        left = y
        for _ in range(_FITS if len(y) > terms.shape[1] else 0):
            left = y - terms @ np.linalg.lstsq(terms * weight[:, None], y * weight, rcond=None)[0]
            scale = max(1e-6, 2 * 1.4826 * float(np.median(np.abs(left))))
            weight = 1 / np.sqrt(1 + (left / scale) ** 2)
        log_gain = self.log_gain.copy()
        log_gain[at] = left
        return replace(self, log_gain=log_gain)


@dataclass(frozen=True)
class LitScene:
    """The small images of a reconstruction in daylight, with the brightness of what they show."""

    scene: StillScene
    medium: MediumFit  # of values as stored

    @cached_property
    def _brightness(self) -> Callable[[int], np.ndarray]:
        return lru_cache(maxsize=128)(self._read_brightness)

    def flicker(self, i: int) -> Flicker:
        """The gains that even out frame `i`, by the frames that see the same surfaces."""
        own = self._brightness(i)
        total, count = own.copy(), (own > 0).astype(np.float32)
        for j in self.scene.others(i):
            seen = self._seen(i, j)
            total, count = total + seen, count + (seen > 0)
        return _gain(own, total / np.maximum(count, 1), count >= _LEAST_FRAMES)

    def change(self, i: int, j: int) -> Flicker:
        """Of what frame `i` shows, the change until frame `j`, without what goes with the brightness of surfaces.

        That is how errors of the water change: backscatter that is off takes from dark surfaces more than from bright.
        """
        own, seen = self._brightness(i), self._seen(i, j)
        change = _gain(own, seen, seen > 0)
        at = change.measured
        if not at.any():
            return change
        below = np.log(np.maximum(_blurred(own * at, _SMOOTH), 1e-6) / np.maximum(_blurred(at, _SMOOTH), 1e-6))
        between = (below + change.log_gain / 2)[at]  # of both frames: it goes with neither one's light
        left = change.log_gain.copy()
        left[at] -= np.polyval(np.polyfit(between, left[at], 2), between)
        return replace(change, log_gain=left)

    def brightness(self, i: int, at: Bool[np.ndarray, "h w"]) -> float:
        """Median brightness of some pixels of frame `i`."""
        return float(np.median(self._brightness(i)[at]))

    def _seen(self, i: int, j: int) -> Float[np.ndarray, "h w"]:
        """Brightness in frame `j` of the surfaces at the pixels of frame `i`; 0 where it does not show them."""
        import cv2

        known = self._brightness(i) > 0
        xyz = self.scene.points(i, self.scene.view(i).z_depth, np.flatnonzero(known))
        uv, z, visible = (part[0].numpy() for part in project_visible(self.scene.cameras[j], xyz[None]))
        x, y = (np.full(known.shape, -1, np.float32) for _ in range(2))
        x[known], y[known] = np.where(visible, uv.T - 0.5, -1)
        depth, bright = self.scene.view(j).z_depth.astype(np.float32), self._brightness(j)
        there = cv2.remap(depth, x, y, cv2.INTER_NEAREST)[known]
        seen = cv2.remap(bright, x, y, cv2.INTER_LINEAR)
        whole = cv2.remap((bright > 0).astype(np.float32), x, y, cv2.INTER_LINEAR)[known] > 0.99
        same = np.zeros_like(known)
        same[known] = visible & whole & (np.abs(there - z) < _SAME * z)
        return np.where(same, seen, 0)

    def _read_brightness(self, i: int) -> Float[np.ndarray, "h w"]:
        """Brightness of the measured surfaces of a frame; 0 elsewhere."""
        view = self.scene.view(i)
        known = (view.z_depth > 0) & view.usable
        z_depth = torch.from_numpy(view.z_depth.astype(np.float32))
        ray_depth = ray_depth_map(z_depth, frame_rays(view.camera))
        medium = self.medium.at(ray_depth, frame_directions(view.camera))
        direct = torch.from_numpy(view.rgb.astype(np.float32)) - backscatter(ray_depth, medium)
        bright = direct.sum(-1) / transmittances(ray_depth, medium)[0].sum(-1)
        return np.where(known, bright.clamp(min=_DARKEST).numpy(), 0).astype(np.float32)


def with_steady(
    rec: Reconstruction, frames: Frames, restore: RestoreSettings, folder: Path, progress: Progress = silent
) -> Reconstruction:
    """The reconstruction with its frames in steady light, in a new folder, where the light flickers.

    Needs water in daylight; under a lamp there is no sun to flicker. Frames of an earlier call are kept.
    """
    if rec.medium is None or rec.medium.lamp is not None:
        return rec
    if not folder.is_dir():
        lit = LitScene(still_scene(rec, frames), rec.medium)
        spread, change, toned = _spread(lit, len(rec.names))
        if not (spread >= _FLICKERS and change >= _LEAST_CHANGE):
            return rec
        if toned >= _TONED:
            log.info("frames differ in brightness by gains over large parts of them: %.0f%% of the change", 100 * toned)
            return rec
        log.info("the sunlight flickers over the ground, by %.1f%% of its brightness from frame to frame", 100 * spread)
        _write_steady(rec, frames, lit, restore, folder, progress)
    warning = QualityWarning(
        "Sunlight flickers over the ground (caustics). Restored frames, cloud and map are made from frames in steady"
        " light; test frames keep the flicker, which lowers their scores.",
        f"Look through sfm/{folder.name}. `--flicker keep` takes the frames as filmed.",
    )
    return replace(rec, steady=SteadyFrames(folder), warnings=(*rec.warnings, warning))


def _write_steady(
    rec: Reconstruction, frames: Frames, lit: LitScene, restore: RestoreSettings, folder: Path, progress: Progress
) -> None:
    """Write the frames that have depth in steady light."""
    with atomic_folder(folder) as draft:

        def write(i: int) -> None:
            even = _evened(rec, frames, i, lit.flicker(i), restore)
            if even is not None:
                images.write_rgb(draft / f"{rec.names[i]}.png", even.numpy())

        for i, _ in enumerate(in_order(write, range(len(rec.names)))):
            progress("evening out the sunlight", i, len(rec.names))
    progress("evening out the sunlight", len(rec.names), len(rec.names))


def _spread(lit: LitScene, count: int) -> tuple[float, float, float]:
    """Medians over a few frames of the change until the second next, per frame: of the logarithm, and of brightness;
    and the share of the first one's square that shadings explain.

    NaN where in half of them too little is seen twice.
    """
    probes = np.unique(np.linspace(0, count - 1 - _NEXT, _PROBES).round().astype(int)) if count > _NEXT else []
    told = []
    for i in map(int, probes):
        change = lit.change(i, i + _NEXT)
        spread = change.spread / 2**0.5
        if np.isfinite(spread):
            left = change.beyond_shading().spread / 2**0.5
            told.append((spread, spread * lit.brightness(i, change.measured), left))
    if 2 * len(told) <= len(probes):
        return float("nan"), float("nan"), float("nan")
    spread, change, left = np.median(told, axis=0).tolist()
    return spread, change, 1 - (left / spread) ** 2 if spread > 0 else 0.0


def _evened(
    rec: Reconstruction, frames: Frames, i: int, flicker: Flicker, restore: RestoreSettings
) -> Float[Tensor, "h w 3"] | None:
    """A frame with its direct light times the gains; None of one without depth. Open water stays as it is."""
    import cv2

    assert rec.medium is not None
    depth, filmed = rec.depth[rec.names[i]], frames.image(frames.index(rec.names[i]))
    if not bool((depth.z_depth > 0).any()):
        return None
    camera = rec.cameras[i]
    seen = restore_image(filmed, depth, frame_rays(camera), rec.medium, restore)
    size = (camera.width, camera.height)
    gain = torch.from_numpy(np.exp(cv2.resize(flicker.log_gain, size, interpolation=cv2.INTER_LINEAR))).float()
    veil = backscatter(seen.ray_depth, rec.medium.at(seen.ray_depth, frame_directions(camera)))
    return (filmed + ((gain - 1) * (1 - seen.sea))[..., None] * (filmed - veil)).clamp(0, 1)


def _gain(own: Float[np.ndarray, "h w"], other: Float[np.ndarray, "h w"], measured: Bool[np.ndarray, "h w"]) -> Flicker:
    """The logarithm of other : own brightness, both blurred."""
    weight = measured.astype(np.float32)
    above, below = (np.maximum(_blurred(x * weight, _SMOOTH), 1e-6) for x in (other, own))
    return Flicker(_filled(np.clip(np.log(above / below), -_MOST, _MOST), _blurred(weight, _SMOOTH)), measured)


def _filled(value: Float[np.ndarray, "h w"], weight: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Values of some weight, followed by those around where there is little, and by 0 far from any."""
    around = _blurred(value * weight, _FILL) / (_blurred(weight, _FILL) + _FAR_HOLD)
    return (value * weight + _HOLD * around) / (weight + _HOLD)


def _blurred(x: np.ndarray, sigma: float) -> Float[np.ndarray, "h w"]:
    import cv2

    return cv2.GaussianBlur(x.astype(np.float32), (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
