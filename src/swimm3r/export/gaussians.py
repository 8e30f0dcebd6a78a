"""A map as Gaussians that 3DGS viewers show, without its water.

Gaussians leave as they are. A Beta splat of exponent
B on the ellipse of covariance S has on the image plane the mass and the second moments of a Gaussian with
(docs/derivations/beta-primitives.md#a-gaussian-of-equal-moments)

    covariance S / (2 (B + 2)),   peak o (B + 2) / (B + 1), at most 0.999

A viewer's Gaussian knows neither conditioned direction nor time, so S is that seen from the mean direction of the
cameras that have the primitive in their image, and o their mean. How much is lost is measured: `clear_difference`.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from swimm3r.cameras import Cameras
from swimm3r.evaluate.images import psnr_from_errors
from swimm3r.raster import ALPHA_MAX, ALPHA_MIN, RasterOutput, rasterize
from swimm3r.splat.block_store import BlockEntry, StoredBlocks
from swimm3r.splat.gaussian_settings import GaussianRenderSettings
from swimm3r.splat.medium.field import MediumField
from swimm3r.splat.primitives.beta import BetaPrimitives, kernel_exponent, select
from swimm3r.splat.primitives.gaussian import GaussianPrimitives, colored, covariance, mean_color
from swimm3r.splat.projection.conditioning import Conditioned, queries, shown
from swimm3r.splat.projection.dispatch import project
from swimm3r.splat.projection.pixel_filter import smoothed
from swimm3r.splat.projection.plain import project_conditioned
from swimm3r.splat.projection.view_camera import view_camera
from swimm3r.splat.rendering import SplatMap, projected, settings_in_scene_units
from swimm3r.splat.settings import RenderSettings

ASKED = 64  # cameras, spread over the dive, that say which way a primitive is looked at
_MOST_OFF = 1.5  # factor between a mean color and the map's; beyond, something else is wrong


@dataclass(frozen=True)
class Gaussians:
    """Clear splats in the axes and unit of the reconstruction."""

    xyz: Float[Tensor, "n 3"]
    rgb: Float[Tensor, "n 3"]  # without the water, not bounded; the mean over all directions
    opacity: Float[Tensor, " n"]  # peak, 0..1
    covariance: Float[Tensor, "n 3 3"]
    harmonics: Float[Tensor, "n h 3"]  # of the color from degree 1 on (splat.spherical); none of Beta maps


@dataclass(frozen=True)
class ClearDifference:
    """Difference between the clear images of the Gaussians and of the map, over some cameras."""

    psnr: float  # dB, of colors blended over black
    alpha: float  # mean difference of opacity, Gaussians minus map


def clear_gaussians(scene: SplatMap, cameras: Cameras, time: float | None = None) -> Gaussians:
    """The map's primitives as Gaussians, Beta ones as `cameras` see them on average; what is too faint is left out.

    A map in blocks asks, for each block, some of the cameras that see it, and needs the memory of one block besides.
    Raises ValueError where a dynamic map is given no time.
    """
    p = scene.primitives
    if scene.blocks is not None:
        return _joined(
            [_of_block(scene, scene.blocks, entry, cameras) for entry in scene.blocks.entries if entry.primitives]
        )
    if isinstance(p, BetaPrimitives):
        return moment_matched(scene, cameras, time)
    p = select(p, torch.sigmoid(p.opacity) >= ALPHA_MIN)
    peak = torch.sigmoid(p.opacity).clamp(max=ALPHA_MAX)
    shape = smoothed(covariance(p), torch.full_like(peak, 0.5), p.footprint, scene.settings.render)
    gain, offset = _mean_affine(scene, p, cameras)
    return Gaussians(p.xyz, gain * mean_color(p) + offset, peak, shape, gain[:, None] * p.harmonics)


def _mean_affine(
    scene: SplatMap, p: GaussianPrimitives, cameras: Cameras
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Gain and offset of colors that change with the camera, averaged over `cameras`; 1 and 0 where they do not."""
    gain, offset = torch.ones_like(p.color), torch.zeros_like(p.color)
    field = scene.field
    if not isinstance(field, MediumField) or field.affine_colors is None or not len(cameras):
        return gain, offset
    views = [view_camera(cameras[i]) for i in range(len(cameras))]
    with torch.no_grad():
        found = [field.affine_colors.affine(p.xyz, mean_color(p), view, field.length) for view in views]
    return torch.stack([g for g, _ in found]).mean(0), torch.stack([b for _, b in found]).mean(0)


def _of_block(scene: SplatMap, blocks: StoredBlocks, entry: BlockEntry, cameras: Cameras) -> Gaussians:
    views = [k for k in range(len(cameras)) if entry.is_in(view_camera(cameras[k]))]
    asked = [views[k] for k in spread(len(views), ASKED).tolist()] if views else []
    alone = replace(scene, primitives=blocks.read(entry), blocks=None)
    return moment_matched(alone, cameras[asked])


def _joined(parts: list[Gaussians]) -> Gaussians:
    return Gaussians(*(torch.cat([vars(g)[name] for g in parts]) for name in vars(parts[0])))


def spread(count: int, most: int) -> Int[Tensor, " k"]:
    """At most so many of `count` places, evenly spread."""
    return torch.linspace(0, count - 1, min(most, count)).round().long()


def moment_matched(scene: SplatMap, cameras: Cameras, time: float | None = None) -> Gaussians:
    """A Beta map's primitives as `cameras` see them on average, those too faint to see left out.

    Raises ValueError where a dynamic map is given no time.
    """
    now, settings = scene.normalized_time(time), settings_in_scene_units(scene.settings, scene.length).render
    p = scene.primitives
    assert isinstance(p, BetaPrimitives)
    assert isinstance(settings, RenderSettings)
    direction, share, seen = (torch.zeros(len(p.xyz), k) for k in (3, 1, 1))
    with torch.no_grad():
        for i in range(len(cameras)):
            view = view_camera(cameras[i])
            drawn = project(p, view, settings, now)
            at, reach = drawn.primitives.mean2d, drawn.radius[:, None]
            size = torch.tensor([view.width, view.height])
            inside = ((at > -reach) & (at < size + reach)).all(-1, keepdim=True) & (drawn.radius[:, None] > 0)
            direction += inside * queries(p.xyz, view.center)
            share += inside * drawn.primitives.opacity[:, None]
            seen += inside
        found = seen[:, 0] > 0
        p = select(p, found)
        query = normalize(direction[found], dim=-1)
        if now is not None:
            query = torch.cat([query, now.expand(len(query), 1)], -1)
        state, B = shown(p, query, settings), kernel_exponent(p)
        peak = ((share / seen.clamp(min=1))[found, 0] * (B + 2) / (B + 1)).clamp(max=ALPHA_MAX)
        shape = state.covariance / (2 * (B + 2))[:, None, None]
        visible = peak >= ALPHA_MIN
    none = torch.zeros(int(visible.sum()), 0, 3)
    return Gaussians(state.mean[visible], p.rgb[visible], peak[visible], shape[visible], none)


def draw_gaussians(g: Gaussians, camera: Cameras, near: float) -> RasterOutput:
    """The image of a 3DGS viewer: exp(-r2 / 2) under the image plane's covariance with its 0.3 px^2 of blur."""
    view = view_camera(camera)
    half = torch.full_like(g.opacity, 0.5)
    rgb = colored(g.rgb, g.harmonics, g.xyz - view.center)
    shapes, settings = Conditioned(g.xyz, g.covariance, g.opacity), GaussianRenderSettings(near=near)
    p = project_conditioned(shapes, half, rgb, view, settings).primitives
    return rasterize(p, None, view.height, view.width, kernel="gaussian")


def with_mean_color(scene: SplatMap, g: Gaussians, cameras: Cameras, time: float | None = None) -> Gaussians:
    """The Gaussians of a Beta map, their channels scaled so that the mean color seen by `cameras` is that of the map.

    Colors below 0, which a viewer takes for 0, and shapes that change with the view would brighten them as a whole.
    """
    seen = [_both(scene, g, cameras[i], time) for i in range(len(cameras))]
    theirs, own = (torch.stack([pair[k].clear.mean((1, 2)) for pair in seen]).mean(0) for k in (0, 1))
    return replace(g, rgb=g.rgb * (own / theirs.clamp(min=1e-6)).clamp(1 / _MOST_OFF, _MOST_OFF))


def clear_difference(
    scene: SplatMap,
    g: Gaussians,
    cameras: Cameras,
    time: float | None = None,
    gains: Float[Tensor, "3"] | None = None,
) -> ClearDifference:
    """The Gaussians against the map they were made of, both without water and before black, seen by `cameras`.

    `gains` are the white balance that the Gaussians have and the map has not.
    """
    balance = torch.ones(3) if gains is None else gains
    colors, alphas = [], []
    for i in range(len(cameras)):
        theirs, own = _both(scene, g, cameras[i], time)
        colors.append(theirs.clear - balance[:, None, None] * own.clear)
        alphas.append(float((theirs.alpha - own.alpha).mean()))
    return ClearDifference(psnr_from_errors(torch.stack(colors)), float(np.mean(alphas)))


def _both(scene: SplatMap, g: Gaussians, camera: Cameras, time: float | None) -> tuple[RasterOutput, RasterOutput]:
    """One view of the Gaussians as a 3DGS viewer draws them, and of the map without its water."""
    settings, now = settings_in_scene_units(scene.settings, scene.length), scene.normalized_time(time)
    with torch.no_grad():
        view = view_camera(camera)
        seen = projected(scene.seen_by(view), scene.field, view, settings, now)
        own = rasterize(seen.primitives, None, view.height, view.width, kernel=seen.kernel)
        return draw_gaussians(g, camera, settings.render.near), own
