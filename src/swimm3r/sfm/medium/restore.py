"""Images and points as they would look without the water: the inverse of Eq. 3, kept from amplifying noise.

    D = I - B(z),   J = D / T_D(z)

Where T_D is small the quotient is noise, so per channel with s = T_D:

    detail    J = S + s^2 / (s^2 + (noise / texture)^2) (J - S)     S: local linear fit of D / s to I's brightness
    color    J = w J + (1 - w) k G,  w = s^2 / (s^2 + (veil_error / color_error)^2)
              G: the channels weighted by how well they see; k: this channel's share of color where it does see;
    horizon   in open water, and where no channel sees (max w -> 0), the image's own veil remains

Under a lamp on the camera T_D is the share of its light that arrives (`MediumFit.at`), so that J is evenly lit. Near
the camera all weights are 1 and J is the plain inverse. Nothing is stretched; white balance serves the eye alone, and
leads less far where the frames do not say which colors the water took (`plausibility`).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from swimm3r.imaging.clipped import clipped
from swimm3r.imaging.depth_completion import fill_z_depth
from swimm3r.imaging.depth_from_color import depth_from_color
from swimm3r.imaging.filters import blur, local_linear
from swimm3r.imaging.gray import LUMA
from swimm3r.imaging.open_water import sea_share, without_fringe
from swimm3r.imaging.undistortion import frame_rays
from swimm3r.medium import (
    MediumFit,
    backscatter,
    expected_colors,
    linear_from_srgb,
    remove_water,
    srgb_from_linear,
    transmittances,
)
from swimm3r.progress import Progress, silent
from swimm3r.scene.frames import Frames
from swimm3r.scene.point_groups import PointGroups
from swimm3r.scene.reconstruction import DepthMap, Reconstruction
from swimm3r.scene.white_balance import BRIGHTEST, WhiteBalance
from swimm3r.sfm.medium.dense_tracks import ray_depth_map
from swimm3r.sfm.medium.plausibility import any_determined, attenuation_is_a_guess
from swimm3r.sfm.medium.settings import RestoreSettings
from swimm3r.sfm.medium.side_by_side import in_order

_MAX_TINT = 1.001  # times the other channels, for blurred colors at a guessed distance; gray is 1
_MAX_BRIGHTNESS = 0.9  # of blurred colors there, in any channel
_LEAST_CORRECTED = 0.7  # of a guessed depth, down to which colors correct it; beyond that it is the water that is wrong
_LEAST_TRIED = 0.05  # of a guessed depth in daylight, where colors stand in for what is wrong with the water
_LEVELS, _FEWEST = 20, 20  # levels of brightness from 0 to 1, and surfaces of a level that tell how bright it becomes
_NEARLY_ALL = 0.95  # of the surfaces at known distance
_SAMPLES = 20_000  # of them, which stand for all of an image
_VIEWS, _PIXELS = 12, 2_000  # frames, and pixels of each, that tell how bright the surfaces of a dive become
_BEYOND_WHITE = 0.01  # of these pixels, at most


@dataclass(frozen=True)
class RestoredImage:
    """One whole image without its water, as stored values in 0..1."""

    clear: Float[Tensor, "h w 3"]
    shown: Float[Tensor, "h w 3"]  # white-balanced for the eye where asked for
    ray_depth: Float[Tensor, "h w"]  # of the surface; a guess where the depth map has gaps, corrected by color
    sea: Float[Tensor, "h w"]  # 0..1, how surely there is open water and no surface; it keeps the color it has


def restored_images(
    rec: Reconstruction,
    frames: Frames,
    settings: RestoreSettings,
    progress: Progress = silent,
    keep: Callable[[int, RestoredImage], None] = lambda i, image: None,
) -> Iterator[tuple[int, RestoredImage]]:
    """Every registered frame with some known depth, by its place in `rec`; needs medium, cloud and balance.

    Frames are restored side by side and come in their order; `keep` is called with each where it was made.
    """
    assert rec.medium is not None
    assert rec.cloud is not None
    medium, gains, cloud = rec.medium, rec.white_balance.factors, PointGroups(rec.cloud.xyz)

    def restored(i: int) -> RestoredImage | None:
        depth = rec.depth[rec.names[i]]
        if not bool((depth.z_depth > 0).any()):
            return None
        filmed = frames.image(frames.index(rec.names[i]))
        elsewhere = cloud.z_depth(rec.cameras[i])
        image = restore_image(filmed, depth, frame_rays(rec.cameras[i]), medium, settings, gains, elsewhere)
        keep(i, image)
        return image

    yield from told(restored, len(rec.names), progress)


def told(
    restored: Callable[[int], RestoredImage | None], count: int, progress: Progress
) -> Iterator[tuple[int, RestoredImage]]:
    """The images of all frames that have one, in order, with the progress told."""
    for i, image in enumerate(in_order(restored, range(count))):
        progress("restoring images", i, count)
        if image is not None:
            yield i, image
    progress("restoring images", count, count)


def restore_image(
    image: Float[Tensor, "h w 3"],
    depth: DepthMap,
    rays: Float[Tensor, "h w 3"],
    fit: MediumFit,
    settings: RestoreSettings | None = None,
    gains: Float[Tensor, "3"] | None = None,
    elsewhere: Float[Tensor, "h w"] | None = None,
) -> RestoredImage:
    """The whole image without its water; unknown depth is filled in along the edges, and from z-depth `elsewhere`
    measured (`fill_z_depth`). Colors correct what is filled in, unless the light lost on the way is itself a guess.

    `rays` are the directions of the pixels with z = 1 (`cameras.image_directions`). `gains` (`display_gains`) color
    surfaces and not the open water behind them, which keeps the color the diver saw.
    """
    settings = settings or RestoreSettings()
    direction = torch.nn.functional.normalize(torch.nan_to_num(rays, nan=0.0), dim=-1)
    water = fit.open_water(direction)
    veil = srgb_from_linear(water) if fit.encoding == "linear" else water
    depth = replace(depth, z_depth=without_fringe(image, depth.z_depth, veil))
    sea = sea_share(image, depth.z_depth, veil)
    I = linear_from_srgb(image) if fit.encoding == "linear" else image
    tells = not attenuation_is_a_guess(fit)  # colors tell distances
    z_depth = fill_z_depth(image, depth, sea, elsewhere, depth_from_color(I, depth, sea, rays, fit) if tells else None)
    ray_depth = ray_depth_map(z_depth, rays)
    path = _not_beyond_white(I, ray_depth, direction, depth.z_depth == 0, fit) if tells else ray_depth
    medium = fit.at(path, direction)
    T_D, _ = transmittances(path, medium)
    direct = I - backscatter(path, medium)
    J = _without_noise(direct, T_D, I @ LUMA, settings)
    stored = srgb_from_linear(J.clamp(min=0)) if fit.encoding == "linear" else J
    clear = keep_open_water(stored, T_D, image, sea, settings).clamp(0, 1)
    shown = clear if gains is None else keep_open_water(stored * gains, T_D, image, sea, settings).clamp(0, 1)
    surface = torch.where(path > _LEAST_CORRECTED * ray_depth, path, ray_depth)
    return RestoredImage(clear, shown, surface, sea)


def white_balance(rec: Reconstruction, settings: RestoreSettings) -> WhiteBalance:
    """The one balance of a dive with a restored cloud: gray on average (`display_gains`).

    Where the frames determine nothing of the water, neutral grays would pass for the true colors of surfaces: what it
    says of the hue is believed as far as it leads toward gray (`milder_gains`). Where the light lost on the way is a
    guess, colors are shown as filmed, and under a lamp, whose beam frames tell all the same, evenly lit in the hue as
    filmed. Gains are ones where nobody asked for any.
    """
    assert rec.cloud is not None
    assert rec.medium is not None
    guess = attenuation_is_a_guess(rec.medium)
    if guess and rec.medium.lamp is None:
        return WhiteBalance(source="filmed")
    if not settings.white_balance:
        return WhiteBalance()
    if any_determined(rec.medium) and not guess:
        gains = display_gains(rec.cloud.restored)
    else:
        gains = milder_gains(rec.cloud.raw, rec.cloud.restored, 0.0 if guess else 1.0)
    red, green, blue = gains.tolist()
    return WhiteBalance((red, green, blue))


def within_white(rec: Reconstruction, frames: Frames, balance: WhiteBalance) -> WhiteBalance:
    """The balance with one common gain, 0.5 to 1, by which at most a hundredth of what the frames show is beyond white.

    What the water takes from far surfaces makes them brighter than any filmed one once it is given back, and frames in
    a common exposure may be brighter than they were taken. Pixels that are clipped as filmed tell nothing.
    """
    assert rec.medium is not None
    if balance.source == "filmed":
        return balance
    as_filmed, brightness = replace(frames, own_colors=None), [torch.zeros(0)]
    for i in range(0, len(rec.names), -(-len(rec.names) // _VIEWS)):
        z_depth = rec.depth[rec.names[i]].z_depth
        pixel = torch.nonzero(z_depth.flatten() > 0)[:, 0]
        pixel = pixel[:: max(1, len(pixel) // _PIXELS)]
        f = frames.index(rec.names[i])
        pixel = pixel[~clipped(as_filmed.colors(f, pixel)).any(-1)]
        filmed = frames.colors(f, pixel)
        rays = frame_rays(rec.cameras[i]).reshape(-1, 3)[pixel]
        length = rays.norm(dim=-1)
        path = z_depth.flatten()[pixel] * length
        I = linear_from_srgb(filmed) if rec.medium.encoding == "linear" else filmed
        J = remove_water(I, path, rec.medium.at(path, rays / length[:, None]))
        stored = srgb_from_linear(J.clamp(min=0)) if rec.medium.encoding == "linear" else J
        brightness.append((stored * balance.factors).amax(-1))
    seen = torch.cat(brightness)
    seen = seen[seen.isfinite()].numpy()
    white = float(np.quantile(seen, 1 - _BEYOND_WHITE)) if len(seen) else 1.0
    red, green, blue = (balance.factors / min(max(white, 1.0), BRIGHTEST)).tolist()
    return replace(balance, gains=(red, green, blue))


def display_gains(restored: Float[Tensor, "n 3"]) -> Float[Tensor, "3"]:
    """Gains that make a dive's restored colors gray, between 0.5 and 2; brightness stays.

    The inverse of the water gives surfaces under the light that reaches their depth, which is tinted. This is for
    images to look at and nothing else: it is no part of J.
    """
    tint = _tint(restored[_unclipped(restored)])
    return (tint.mean() / tint).clamp(0.5, 2.0).float()


def milder_gains(filmed: Float[Tensor, "n 3"], restored: Float[Tensor, "n 3"], most: float = 1.0) -> Float[Tensor, "3"]:
    """Gains of the colors of one cloud that take back what their restoration changes of the hue beyond gray.

    With f and r the logarithms of both tints less their means, the gains are exp((t - 1) (r - f)) with t = 0..`most`
    where |f + t (r - f)| is least: of the hues between the filmed one and the restored one the nearest to gray. A
    camera that was balanced for the water, or for its lamp, films grays as gray, and the whole correction would turn
    them orange.
    """
    seen = _unclipped(restored)
    f, r = (tint.log() - tint.log().mean() for tint in (_tint(filmed[seen]), _tint(restored[seen])))
    change = r - f
    t = (-(f @ change) / (change @ change).clamp(min=1e-12)).clamp(0, most)
    return ((t - 1) * change).exp().clamp(0.5, 2.0).float()


def _unclipped(colors: Float[Tensor, "n 3"]) -> Bool[Tensor, " n"]:
    return (colors < 0.99).all(-1)


def _tint(colors: Float[Tensor, "n 3"]) -> Float[Tensor, "3"]:
    """The 6-norm of colors (Finlayson & Trezzi 2004), ones of none: bright surfaces count most, shade hardly."""
    if len(colors) == 0:
        return torch.ones(3, dtype=torch.float64)
    return ((colors.double().clamp(min=0) ** 6).mean(0) ** (1 / 6)).clamp(min=0.01)


def _not_beyond_white(
    I: Float[Tensor, "h w 3"],
    ray_depth: Float[Tensor, "h w"],
    direction: Float[Tensor, "h w 3"],
    guessed: Bool[Tensor, "h w"],
    fit: MediumFit,
) -> Float[Tensor, "h w"]:
    """Ray depth, shortened where it is a guess until the blurred J is a color that surfaces have.

    That is below 0.9, or no more times as bright as filmed than nearly all surfaces of known depth that were filmed as
    bright, and in the channel that the water takes first not far above the others (nor more than nearly all surfaces of
    known depth are): too long a path shows as a glare of that channel first, mostly red.

    In daylight down to nothing, where the color as filmed is left. Under a lamp by 30 % at most, and not at all where
    that does not help: its light grows so fast toward it that a surface right before it could have any color.
    """
    if not guessed.any():
        return ray_depth
    first = int(fit.beta_D.argmax())
    reach = 0.01 * max(I.shape[:2])
    blurred = blur(I, reach)

    def tint(J: Float[Tensor, "n 3"]) -> Float[Tensor, " n"]:
        others = torch.cat([J[:, :first], J[:, first + 1 :]], dim=-1).amax(-1)
        return torch.where(others > 0, J[:, first] / others.clamp(min=1e-6), torch.inf)

    known = torch.nonzero(~guessed.flatten())[:, 0]
    known = known[:: max(1, len(known) // _SAMPLES)]
    path, toward = ray_depth.flatten()[known], direction.reshape(-1, 3)
    filmed = blurred.reshape(-1, 3)[known]
    J = remove_water(filmed, path, fit.at(path, toward[known]))
    most = max(_MAX_TINT, _of_nearly_all(tint(J)))
    gain = _brightening(filmed.amax(-1), J.amax(-1))
    cell, pixel = _cells(guessed, max(1, round(reach / 3)))  # the blurred image is the same within a cell
    smooth, far = blurred.reshape(-1, 3)[pixel], ray_depth.flatten()[pixel]
    if fit.lamp is None:
        least, shortened = _LEAST_TRIED, torch.zeros_like(far)
    else:
        least, shortened = _LEAST_CORRECTED, torch.ones_like(far)
    bright = (gain[_level(smooth.amax(-1))] * smooth.amax(-1)).clamp(min=_MAX_BRIGHTNESS)
    for trial in torch.linspace(least, 1.0, 20):
        J = remove_water(smooth, trial * far, fit.at(trial * far, toward[pixel]))
        shortened = torch.where((J.amax(-1) < bright) & (tint(J) <= most), trial, shortened)
    share = torch.ones_like(ray_depth)
    share[guessed] = shortened[cell]
    return torch.where(guessed, ray_depth * blur(share[..., None], reach)[..., 0], ray_depth)


def _brightening(filmed: Float[Tensor, " n"], restored: Float[Tensor, " n"]) -> Float[Tensor, " levels"]:
    """Times that nearly all surfaces are as bright as filmed, at most, by the level of their brightness as filmed.

    Levels that too few surfaces have are those of the nearest that enough have; 1 at least, and where none has.
    """
    level = _level(filmed)
    enough = [k for k in range(_LEVELS) if int((level == k).sum()) >= _FEWEST]
    if not enough:
        return torch.ones(_LEVELS)
    gain = {k: max(1.0, _of_nearly_all((restored / filmed.clamp(min=1e-6))[level == k])) for k in enough}
    return torch.tensor([gain[min(enough, key=lambda other: abs(other - k))] for k in range(_LEVELS)])


def _level(brightness: Float[Tensor, " n"]) -> Int[Tensor, " n"]:
    return (brightness * _LEVELS).long().clamp(0, _LEVELS - 1)


def _of_nearly_all(values: Float[Tensor, " n"]) -> float:
    """Quantile `_NEARLY_ALL` of the finite values; 0 of none."""
    finite = values[values.isfinite()].numpy()
    return float(np.quantile(finite, _NEARLY_ALL)) if len(finite) else 0.0


def _cells(mask: Bool[Tensor, "h w"], edge: int) -> tuple[Int[Tensor, " n"], Int[Tensor, " cells"]]:
    """The number of the square cell that each of the mask's pixels lies in, and one of its pixels for each cell."""
    row, column = torch.nonzero(mask, as_tuple=True)
    cell = row // edge * (mask.shape[1] // edge + 1) + column // edge
    last = torch.full(((mask.shape[0] // edge + 1) * (mask.shape[1] // edge + 1),), -1)
    last.scatter_reduce_(0, cell, row * mask.shape[1] + column, "amax")
    used = last >= 0
    return (used.cumsum(0) - 1)[cell], last[used]


def _without_noise(
    direct: Float[Tensor, "h w 3"],
    T_D: Float[Tensor, "h w 3"],
    brightness: Float[Tensor, "h w"],
    settings: RestoreSettings,
) -> Float[Tensor, "h w 3"]:
    """D / T_D with detail and then color held back where T_D does not carry them."""
    floor, sees = settings.veil_error / settings.color_error, _color_weight(T_D, settings)
    J = direct / T_D.clamp(min=floor / 2)
    smooth = local_linear(brightness, J, T_D**2 + 1e-6, settings.window * max(brightness.shape) / 2, settings.noise**2)
    J = smooth + T_D**2 / (T_D**2 + (settings.noise / settings.texture) ** 2) * (J - smooth)
    expected = expected_colors(J, sees, ((J > 0) & (J < 1)).all(-1, keepdim=True))
    return sees * J + (1 - sees) * expected


def _color_weight(T_D: Float[Tensor, "*pixels 3"], settings: RestoreSettings) -> Float[Tensor, "*pixels 3"]:
    """Weight of a channel's own color, as an error of the backscatter grows with its amplification."""
    return T_D**2 / (T_D**2 + (settings.veil_error / settings.color_error) ** 2)


def keep_open_water(
    surface: Float[Tensor, "h w 3"],
    T_D: Float[Tensor, "h w 3"],
    image: Float[Tensor, "h w 3"],
    sea: Float[Tensor, "h w"],
    settings: RestoreSettings,
) -> Float[Tensor, "h w 3"]:
    """The veil itself, as `image` has it, where there is no surface (`sea`, 0..1) or no channel that sees it."""
    floor = settings.veil_error / settings.color_error
    best = T_D.amax(-1, keepdim=True)
    sees = best**2 / (best**2 + floor**2) * (1 - sea[..., None])
    return sees * surface + (1 - sees) * image
