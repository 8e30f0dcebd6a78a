"""A camera that exposed and balanced frames each by itself, told from the colors of the sparse points that they show.

The maps that `imaging.frame_colors` fits to these points even out restored frames, and are the first of a map.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from swimm3r.appearance import ORDERS, FrameColors, cosines, identity_maps
from swimm3r.cameras import Cameras, directions, project, rows_of_frames
from swimm3r.imaging.clipped import clipped
from swimm3r.imaging.filters import blur
from swimm3r.imaging.frame_colors import ColorEvidence, ColorTracks, GroundColors, fit_frame_colors
from swimm3r.imaging.settings import AppearanceSettings
from swimm3r.imaging.undistortion import frame_rays
from swimm3r.medium import backscatter, transmittances
from swimm3r.scene.frames import Frames
from swimm3r.scene.reconstruction import Reconstruction

_ACROSS, _DOWN = 6, 4  # parts of an image that ground has average colors in
_PIXELS, _FEWEST = 4_000, 40  # of an image with measured depth that these are taken of, and of a part that has any
_POINT = 1 / 320  # of the longer side, sigma of the window that a point's color is taken over


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
        at = cosines(_places(canvases[i], toward))
        parts.append((color, away.norm(dim=-1).float(), point, torch.full_like(point, k), toward.float(), at))
    if not parts:
        nothing = torch.zeros(0, dtype=torch.int64)
        return ColorTracks(torch.zeros(0, 3), torch.zeros(0), nothing, nothing, 0)
    color, ray_depth, point, frame, toward, at = (torch.cat(part) for part in zip(*parts, strict=True))
    tracks = ColorTracks(color, ray_depth, point, frame, len(names), gains=_recorded_gains(frames, names), cosines=at)
    if rec.medium is None or rec.medium.encoding != "srgb":
        return tracks
    medium = rec.medium.at(ray_depth, toward)
    ground = None if rec.medium.lamp is None else ground_colors(rec, frames, names)
    T_D, B = transmittances(ray_depth, medium)[0], backscatter(ray_depth, medium)
    return replace(tracks, T_D=T_D, backscatter=B, ground=ground)


def _places(canvas: Cameras, toward: Float[Tensor, "p 3"]) -> Float[Tensor, "p 2"]:
    """Places in a view, 0..1 across and down, of directions in its camera's axes."""
    ahead = canvas.cam2world[0, :3, 3] + toward.double() @ canvas.cam2world[0, :3, :3].mT
    return (project(canvas, ahead[None])[0][0] / torch.tensor([canvas.width, canvas.height])).float()


def ground_colors(rec: Reconstruction, frames: Frames, names: Sequence[str]) -> GroundColors | None:
    """Average colors of ground of measured depth in 24 parts of each of some frames; None where none was measured.

    `rec` has a water on values as stored.
    """
    assert rec.medium is not None
    parts: list[tuple[Tensor, ...]] = []
    canvases = rec.cameras.drawn()
    for k, name in enumerate(names):
        i, f = rec.index(name), frames.index(name)
        if name not in rec.depth:
            continue
        pixel = torch.nonzero((rec.depth[name].z_depth > 0).flatten() & frames.mask(f).flatten())[:, 0]
        pixel = pixel[:: max(1, len(pixel) // _PIXELS)]
        color, rays = frames.colors(f, pixel), frame_rays(rec.cameras[i]).reshape(-1, 3)[pixel]
        length = rays.norm(dim=-1)
        ray_depth, direction = rec.depth[name].z_depth.flatten()[pixel] * length, rays / length[:, None]
        place = _places(canvases[i], direction)
        medium = rec.medium.at(ray_depth, direction)
        shown = torch.cat([color, transmittances(ray_depth, medium)[0], backscatter(ray_depth, medium), place], -1)
        kept = ~clipped(color).any(-1) & shown.isfinite().all(-1) & ((place >= 0) & (place < 1)).all(-1)
        column, row = (place[kept] * torch.tensor([_ACROSS, _DOWN])).long().unbind(-1)
        part, count = (column * _DOWN + row).unique(return_inverse=True, return_counts=True)[1:]
        means = torch.zeros(len(count), shown.shape[1]).index_add_(0, part, shown[kept]) / count[:, None]
        enough = count >= _FEWEST
        parts.append((means[enough], torch.full((int(enough.sum()),), k)))
    if not any(len(frame) for _, frame in parts):
        return None
    means, frame = (torch.cat(part) for part in zip(*parts, strict=True))
    color, T_D, B, place = means.split([3, 3, 3, 2], dim=-1)
    return GroundColors(color, T_D, B, frame, cosines(place))


def _recorded_gains(frames: Frames, names: Sequence[str]) -> Float[Tensor, "f 3"] | None:
    """The gains that the camera recorded; None where it did not for all of the frames."""
    gains = [gain for name in names if (gain := frames.frames[frames.index(name)].gains) is not None]
    return torch.tensor(gains, dtype=torch.float64) if len(gains) == len(names) else None
