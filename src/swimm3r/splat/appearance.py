"""Frames that a camera exposed and balanced each by itself: their maps, and whether a dive needs any.

    I_f = e^(s_f) (M_f S + b_f),    mean of M_f = identity, mean of b_f = 0, mean of s_f = 0

S being what the map renders, water included: a frame's map is applied after the water. Its shading s_f changes smoothly
over the image (`swimm3r.shading`), and is 0 where the dive shows none. Training compares in the colors of S, which the
dive has on average: a view is handed out as M_f^-1 (e^(-s_f) I_f - b_f), so that every recipe is served alike. The
first maps are those of the sparse tracks (`imaging.frame_colors`), which also decide before training whether there
are any; a few times during training they are fitted again to what the map shows by then.
"""

import json
import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from swimm3r.cameras import directions, project, rows_of_frames
from swimm3r.imaging.clipped import clipped
from swimm3r.imaging.filters import blur
from swimm3r.imaging.frame_colors import ColorEvidence, ColorTracks, about_identity, fit_frame_colors, identity_maps
from swimm3r.io.files.atomic import write_text
from swimm3r.io.files.damage import Remedy
from swimm3r.io.files.json_file import read_json
from swimm3r.medium import backscatter, transmittances
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction
from swimm3r.shading import ORDERS, cosines, gains, image_cosines
from swimm3r.splat.shared_settings import AppearanceSettings

log = logging.getLogger(__name__)

_POINT = 1 / 320  # of the longer side, sigma of the window that a point's color is taken over
_FILE = "appearance.json"
_STAY_GAIN, _STAY_MIX = 1e-4, 3e-3  # hold of a refit to the map of before: gains, and mixing or offsets


@dataclass(frozen=True)
class ColorFit:
    """The way from colors that were rendered to those of a frame: affine, and then shaded where there is a shading."""

    maps: Float[Tensor, "3 4"]
    shading: Float[Tensor, "k 3"] | None


@dataclass(frozen=True)
class FrameColors:
    """The maps and shadings of some frames; identity on average."""

    names: tuple[str, ...]
    maps: Float[Tensor, "n 3 4"]
    shading: Float[Tensor, "n k 3"] | None = None  # None where gains do not change over the image

    def common(self, name: str, rgb: Float[Tensor, "3 h w"]) -> Float[Tensor, "3 h w"]:
        """A frame's colors as the dive has them on average."""
        k = self.names.index(name)
        if self.shading is not None:
            rgb = rgb / gains(self.shading[k].to(rgb.device), *rgb.shape[1:])
        M = self.maps[k]
        inverse, offset = torch.linalg.inv(M[:, :3].double()).float(), M[:, 3, None, None]
        return torch.einsum("ij,jhw->ihw", inverse.to(rgb.device), rgb - offset.to(rgb.device))

    def refitted(self, fits: Sequence[ColorFit]) -> "FrameColors":
        """The maps after `fits`, from what the map shows to each frame in the common colors of before.

        Shadings add up, as they would if maps did not mix channels; later fits find what that leaves.
        """
        old, new = self.maps.double(), torch.stack([fit.maps for fit in fits]).double()
        matrix = old[..., :3] @ new[..., :3]
        offset = (old[..., :3] @ new[..., 3:])[..., 0] + old[..., 3]
        maps = about_identity(torch.cat([matrix, offset[..., None]], -1)).float()
        if self.shading is None:
            return FrameColors(self.names, maps)
        shading = self.shading + torch.stack([fit.shading for fit in fits if fit.shading is not None])
        return FrameColors(self.names, maps, shading - shading.mean(0))


@dataclass(frozen=True)
class AppearanceDecision:
    """The decision on colors of single frames, with its figures; `splat/appearance.json`."""

    on: bool
    reason: str
    by_water: float | None = None  # share of the variance of a point's color between frames that the water explains
    by_frames: float | None = None  # share that the frames explain of the rest
    spread: float | None = None  # of a point's color between frames, pixel values; no outliers
    spread_left: float | None = None  # after water and frames
    points: int = 0
    shaded: bool = False  # whether gains also change over the image
    by_shading: float | None = None  # share that such gains explain of what water and frames leave
    by_record: float | None = None  # share of the rest that the exposures and white balances explain which are recorded
    record_stops: tuple[float, float, float] | None = None  # range of the recorded gains of red, green, blue, in EV
    record_slope: float | None = None  # of the tone curve: the power of the recorded gains that the images show


@dataclass(frozen=True)
class Appearance:
    """The decision, and the first maps where there are to be any."""

    decision: AppearanceDecision
    colors: FrameColors | None


def decide_appearance(
    rec: Reconstruction, frames: Frames, names: Sequence[str], settings: AppearanceSettings
) -> Appearance:
    """Judge the colors of the frames `names` by their sparse tracks."""
    if settings.mode == "off":
        return Appearance(AppearanceDecision(False, "switched off"), None)
    tracks = color_tracks(rec, frames, names)
    fit = fit_frame_colors(tracks) if len(names) > 2 else None
    if fit is None:
        maps, shading = identity_maps(len(names)), None
        if settings.shading == "on":
            shading = torch.zeros(len(names), len(ORDERS), 3)
        colors = FrameColors(tuple(names), maps, shading) if settings.mode == "on" else None
        return Appearance(AppearanceDecision(colors is not None, "too few points are seen by three frames"), colors)
    e = fit.evidence
    on, reason = _judged(e, settings)
    shaded = fit.shaded if on and _over_images(e, settings) else None
    if shaded is not None:
        reason += (
            f"; gains that change smoothly over each frame explain {max(0.0, e.by_shading or 0.0):.0%} of the rest"
        )
    left = e.both if shaded is None or e.shaded is None else e.shaded
    decision = AppearanceDecision(on, reason, e.by_water, e.by_frames, e.alone, left, e.points, shaded is not None)
    decision = replace(decision, by_shading=e.by_shading, by_record=e.by_record, record_stops=_stops(tracks))
    decision = replace(decision, record_slope=e.slope)
    log.info("colors of single frames %s: %s", "fitted" if on else "not fitted", reason)
    if shaded is not None:
        return Appearance(decision, FrameColors(tuple(names), shaded.maps, shaded.shading))
    return Appearance(decision, FrameColors(tuple(names), fit.maps) if on else None)


def _judged(e: ColorEvidence, settings: AppearanceSettings) -> tuple[bool, str]:
    told = (
        f"of the variation of {e.points:,} points' colors between frames the water explains {e.by_water:.0%}, and"
        f" exposure and white balance of the frames {max(0.0, e.by_frames):.0%} of the rest"
    )
    by_record = e.by_record
    if by_record is not None:
        told += f"; those that the camera recorded explain {max(0.0, by_record):.0%} of it by themselves"
    if settings.mode == "on":
        return True, f"switched on; {told}"
    moved = max(0.0, e.water**2 - e.both**2) ** 0.5
    explained = e.by_frames >= settings.least_explained or (by_record or 0.0) >= settings.least_recorded
    return (explained and moved >= settings.least_change) or _over_images(e, settings), told


def _over_images(e: ColorEvidence, settings: AppearanceSettings) -> bool:
    """Return whether gains of frames change over the image."""
    if settings.shading != "auto":
        return settings.shading == "on"
    return e.is_shaded(settings.least_shading, settings.least_change)


def _stops(tracks: ColorTracks) -> tuple[float, float, float] | None:
    """Range of the recorded gains per channel in EV; None without any."""
    if tracks.gains is None or not len(tracks.gains):
        return None
    logs = tracks.gains.log2()
    red, green, blue = (logs.amax(0) - logs.amin(0)).tolist()
    return red, green, blue


def color_tracks(rec: Reconstruction, frames: Frames, names: Sequence[str]) -> ColorTracks:
    """Colors of the sparse points in some frames; masked and clipped observations are left out."""
    place = {rec.index(name): k for k, name in enumerate(names)}
    rows_of = rows_of_frames(rec.tracks.frame, len(rec.names))
    parts: list[tuple[Tensor, ...]] = []
    canvases = rec.cameras.drawn()
    for i, k in place.items():
        rows = rows_of[i]
        f = frames.index(rec.names[i])
        image, mask = frames.image(f), frames.mask(f)
        column, row = rec.tracks.xy[rows].long().unbind(-1)
        row, column = row.clamp(0, image.shape[0] - 1), column.clamp(0, image.shape[1] - 1)
        color = blur(image, _POINT * max(image.shape[:2]))[row, column]
        kept = mask[row, column] & ~clipped(color).any(-1)
        rows, color = rows[kept], color[kept]
        point = rec.tracks.point[rows]
        away = rec.points.xyz[point].double() - rec.cameras.centers[i].double()
        toward = normalize(directions(rec.cameras[i], rec.tracks.xy[rows].double()[None])[0], dim=-1)
        ahead = rec.cameras.centers[i].double() + toward
        place_in_view = project(canvases[i], ahead[None])[0][0] / torch.tensor([canvases.width, canvases.height])
        at = cosines(place_in_view.float())
        parts.append((color, away.norm(dim=-1).float(), point, torch.full_like(point, k), toward.float(), at))
    if not parts:
        nothing = torch.zeros(0, dtype=torch.int64)
        return ColorTracks(torch.zeros(0, 3), torch.zeros(0), nothing, nothing, 0)
    color, ray_depth, point, frame, toward, at = (torch.cat(part) for part in zip(*parts, strict=True))
    tracks = ColorTracks(color, ray_depth, point, frame, len(names), gains=_recorded_gains(frames, names), cosines=at)
    if rec.medium is None or rec.medium.encoding != "srgb":
        return tracks
    medium = rec.medium.at(ray_depth, toward)
    return replace(tracks, T_D=transmittances(ray_depth, medium)[0], backscatter=backscatter(ray_depth, medium))


def _recorded_gains(frames: Frames, names: Sequence[str]) -> Float[Tensor, "f 3"] | None:
    """The gains that the camera recorded; None where it did not for all of the frames."""
    gains = [gain for name in names if (gain := frames.frames[frames.index(name)].gains) is not None]
    return torch.tensor(gains, dtype=torch.float64) if len(gains) == len(names) else None


def fit_to_view(
    render: Float[Tensor, "3 h w"], target: Float[Tensor, "3 h w"], seen: Float[Tensor, "h w"], *, shaded: bool = False
) -> ColorFit:
    """The map from a rendering to a view, held to the identity where the view's colors do not tell.

    A shading is found together with the affine map, to first order in both.
    """
    weight = seen.reshape(-1).double()
    x = torch.cat([render, torch.ones_like(render[:1])]).reshape(4, -1).double()
    y = target.reshape(3, -1).double()
    waves = image_cosines(*render.shape[1:]).to(x).reshape(len(ORDERS), -1) if shaded else x[:0]
    maps, shading = [], []
    for c in range(3):
        terms = torch.cat([x, waves * x[c]])
        stay = torch.full((len(terms),), _STAY_MIX, dtype=torch.float64, device=x.device)
        stay[c] = _STAY_GAIN
        stay[4:] = _STAY_GAIN
        stay = stay * weight.sum().clamp(min=1.0)
        products = (terms * weight) @ y[c] + stay * torch.eye(len(terms)).to(stay)[c]
        found = torch.linalg.solve((terms * weight) @ terms.mT + stay.diag(), products)
        maps.append(found[:4])
        shading.append(found[4:] / found[c])
    return ColorFit(torch.stack(maps).float(), torch.stack(shading, -1).float() if shaded else None)


def write_decision(folder: Path, decision: AppearanceDecision) -> None:
    """Write appearance.json beside the map."""
    write_text(folder / _FILE, json.dumps(asdict(decision), indent=2) + "\n")


def read_decision(folder: Path) -> AppearanceDecision | None:
    """Read what `write_decision` wrote; None beside a map without it. Raises InputError where it is damaged."""
    path = folder / _FILE
    if not path.is_file():
        return None
    remedy = Remedy(f"remove {folder}; the command that trained the map trains it again")
    return read_json(path, AppearanceDecision, remedy)
